"""Settings of an environment by the names of robot and task, checked and completed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manip_il.errors import UsageError
from manip_il.option import NameOrPath, check_bounds, make_options, option, typed
from manip_il.robots import ROBOTS
from manip_il.sim.config import MOST_HZ, Episodes
from manip_il.sim.shape import SHAPE_HELP
from manip_il.tasks import NAMES, SEVERAL
from manip_il.worlds.table import WORLDS, world_of

ROBOT_HELP = (
    f"{', '.join(ROBOTS)}, the path of your own arm's YAML, or, unmodified, "
    f"{', '.join(f'{name} ({world.about})' for name, world in WORLDS.items())}"
)
TASK_HELP = (
    f"{', '.join((*NAMES, *SEVERAL))}, or the path of your own task's Python file; "
    f"{'; '.join(f'with {name}, ' + ', '.join(world.tasks) for name, world in WORLDS.items())}"
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
    config = world_of(config.robot).complete(config)
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
