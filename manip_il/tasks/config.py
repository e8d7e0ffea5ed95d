"""Settings of an environment by the names of robot and task, checked and completed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manip_il.checks import check_unchanged
from manip_il.errors import UnknownName, UsageError
from manip_il.option import NameOrPath, check_bounds, make_options, option, typed
from manip_il.robots import ROBOTS
from manip_il.sim.config import MOST_HZ, Episodes
from manip_il.sim.shape import CUBE, SHAPE_HELP, Shape
from manip_il.tasks import NAMES, SEVERAL
from manip_il.tasks.stock import table as stock

LIMITS_HZ = 20  # control rate for which tasks give their limits [Hz]; at other rates they last as many seconds
ROBOT_HELP = (
    f"{', '.join(ROBOTS)}, the path of your own arm's YAML, or {stock.ROBOT} or {stock.ALOHA}: gymnasium-robotics' "
    "Fetch and gym_aloha's two arms, unmodified"
)
TASK_HELP = (
    f"{', '.join((*NAMES, *SEVERAL))}, or the path of your own task's Python file; with {stock.ROBOT}, "
    f"{', '.join(stock.STOCK)}; with {stock.ALOHA}, {', '.join(stock.ALOHA_TASKS)}"
)


@dataclass(frozen=True)
class EnvConfig(Episodes):
    """Settings of one environment; every field is part of the fingerprint. `make_config` checks and completes them.

    robot, task: a name, or the `Path` of a user's own file. object: shape and size of what is grasped, as `Shape.parse`
    reads it, or the `Path` of a mesh; empty for the task's default. A name that was stored is a `str`, which no code
    takes for a path.
    """

    robot: NameOrPath = option("panda", ROBOT_HELP, flag="robot.type")
    task: NameOrPath = option("pick_place", TASK_HELP, flag="task.type")
    object: NameOrPath = option("", f"{SHAPE_HELP}; by default the task's own", flag="task.object")

    @property
    def name(self) -> str:
        """Robot and task joined by "_": a file by its name without the suffix, a task without its argument."""
        return f"{Path(self.robot).stem}_{Path(self.task).stem.partition(':')[0]}"


def make_config(
    robot: NameOrPath = EnvConfig.robot,
    task: NameOrPath = EnvConfig.task,
    control_hz: int = 0,
    **settings: Any,
) -> EnvConfig:
    """Return the settings of an environment; what is not given comes from its robot and task.

    This function is for what a person wrote: names that end in `.py` or `.yaml` and objects `mesh:FILE` are paths. What
    is stored goes to `complete`, where a `str` is a name.

    Args:
        robot: Its name, or the path of its YAML.
        task: Its name, or the path of its Python file.
        control_hz: Control steps per second; 0 for the robot's own.
        settings: Other fields of `EnvConfig`.

    Raises:
        UnknownName: for a robot or a task.
        UsageError: for a wrong value.
    """
    settings |= {"robot": typed(robot), "task": typed(task), "object": typed(settings.get("object", ""))}
    return complete(make_options(EnvConfig, control_hz=control_hz, **settings))


def env_of_name(env: EnvConfig | str) -> EnvConfig:
    """Return the environment of a name, `panda` or `panda/lift`; settings as they are."""
    if not isinstance(env, str):
        return env
    robot, _, task = env.partition("/")
    return make_config(robot, task or EnvConfig.task)


def stored_config(
    spec: Any, robot: NameOrPath | None = None, task: NameOrPath | None = None, shape: NameOrPath | None = None
) -> EnvConfig:
    """Return the settings of the environment that a dataset or a policy names; what it names is never a path.

    Args:
        spec: A `RobotTaskSpec` or an `Origin`.
        robot: What the user gave, which replaces the name in `spec`; the same for the task.
        task: See `robot`.
        shape: See `robot`; the object.

    Raises:
        UsageError: if something that is not built in was not given, and whatever else `make_config` raises.
    """
    named = {"robot": robot or spec.robot, "task": task or spec.task, "object": shape or spec.object}
    return complete(replace(EnvConfig(spec.fps), **named))


def complete(config: EnvConfig) -> EnvConfig:
    """Return settings with 0 and empty values filled in from robot and task; raises what `make_config` raises."""
    from manip_il.mdp import LONGEST_EPISODE  # imported here: help needs no numpy

    if isinstance(config.control_hz, float):
        raise UsageError(
            f"control_hz is {config.control_hz}; expected a whole number, as environments are simulated at one"
        )
    check_bounds(config)
    config = _of_stock(config) if config.robot in stock.ROBOTS else _with_task(config)
    if not 1 <= config.control_hz <= MOST_HZ:
        raise UsageError(f"control_hz is {config.control_hz}; expected 1 to {MOST_HZ}")
    if not 0 < config.tolerance < 1:
        raise UsageError(f"tolerance is {config.tolerance} m; expected between 0 and 1")
    if config.horizon > LONGEST_EPISODE:
        raise UsageError(f"horizon is {config.horizon}; expected at most {LONGEST_EPISODE} control steps")
    if config.success_steps < 1 or config.horizon < config.success_steps:
        raise UsageError(
            f"horizon is {config.horizon}, success_steps {config.success_steps}; expected horizon >= success_steps >= 1"
        )
    return config


def _with_task(config: EnvConfig) -> EnvConfig:
    """Canonicalise the object (the default becomes "") and the task's argument; fill in rate and limits."""
    from manip_il.robots.table import get_robot  # imported here: help needs no robot and no simulator
    from manip_il.sim.mesh import mesh_path
    from manip_il.sim.task import TakesArgument
    from manip_il.tasks.table import get_task

    task, robot = get_task(config.task), get_robot(config.robot)
    for file in (config.task, config.robot, mesh_path(config.object)):
        if isinstance(file, Path):
            check_unchanged(file)
    if isinstance(task, TakesArgument):
        config = replace(config, task=task.name)
    if config.object:
        shape, other = Shape.parse(config.object), get_task(config.task, config.object)
        is_own = shape == getattr(task, "shape", CUBE)
        named = config.object if isinstance(config.object, Path) else str(shape)
        task, config = task if is_own else other, replace(config, object="" if is_own else named)
    limits, control_hz = task.limits, config.control_hz or robot.fps
    rate = control_hz / LIMITS_HZ
    return replace(
        config,
        control_hz=control_hz,
        tolerance=config.tolerance or limits.tolerance,
        success_steps=config.success_steps or max(1, round(limits.success_steps * rate)),
        horizon=config.horizon or max(1, round(limits.horizon * rate)),
    )


def _of_stock(config: EnvConfig) -> EnvConfig:
    """Return settings with the stock robot's fixed values; raises `UsageError` if another value was given."""
    robot = stock.ROBOTS[config.robot]
    if config.task not in robot.tasks:
        raise UnknownName(f"task of {config.robot}", str(config.task), robot.tasks)
    if config.object:
        raise UsageError(f"object is {config.object}; {config.robot} is unmodified, so omit --task.object")
    for name, value in robot.fixed.items():
        given = getattr(config, name)
        if given not in (0, value):
            raise UsageError(f"{name} is {given:g}; {config.robot} is unmodified, expected {value:g}")
    settings: dict[str, Any] = {"horizon": config.horizon or robot.horizon, **robot.fixed}
    return replace(config, **settings)
