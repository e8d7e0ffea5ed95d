"""Options that several commands share, each declared once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il.cli.options import Given, given
from manip_il.errors import UsageError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.option import option
from manip_il.robots import ROBOTS
from manip_il.sim.config import CameraConfig, Look
from manip_il.tasks import NAMES
from manip_il.tasks.config import EnvConfig, make_config
from manip_il.tasks.stock import table as stock

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine
    from manip_il.learn.checkpoint import Origin

SMALL_SIDE = 96  # of a picture that a policy learns from [pixels]
SMALL = {"height": SMALL_SIDE, "width": SMALL_SIDE}
_POLICYS = ("robot", "task", "control_hz", "object")  # what a policy says of its environment
_TRUST = (
    "load models, and run code, that a checkpoint names (smolvla, pi0, groot, ...): only for sources that you trust; "
    "only on the command line"
)
_CONDITIONS = "object, dynamics, knocked, sensing, random_actions; with cameras view, clutter, late"
CAMERAS_HELP = "any of front, side, wrist"
OWN_ROBOT_HELP = "its YAML, if the dataset's robot does not ship"
OWN_TASK_HELP = "its Python file, if the dataset's task does not ship"
OWN_OBJECT_HELP = "mesh:FILE:LENGTH as in the recording, if the dataset's object is a mesh"


def env_given(*, of_policy: bool = False) -> Any:
    """Return the field of `--robot.*`, `--task.*`, `--env.*`. of_policy: what is not given is as the policy has it."""
    return given(EnvConfig, defaults=dict.fromkeys(_POLICYS) if of_policy else None)


def env_config(env: Given, origin: Origin | None = None) -> EnvConfig:
    """Return the environment of what was given, else of what a policy says of itself, else of the defaults.

    Raises `UnknownName` for a robot or task, `UsageError` for another value.
    """
    from manip_il.data.dataset import UNKNOWN_TASK

    values = {name: value for name, value in env.items() if value is not None}
    if origin is not None:
        of_policy: dict[str, Any] = {"robot": origin.robot, "control_hz": origin.fps}
        of_policy |= {} if origin.task == UNKNOWN_TASK else {"task": origin.task}
        values = of_policy | values
        if values.get("task") == origin.task:
            values.setdefault("object", origin.object)
    robot, task = values.get("robot", EnvConfig.robot), values.get("task")
    if robot != stock.ROBOT and task in stock.STOCK:
        raise UsageError(f"--task.type={task} is with --robot.type={robot}; expected {stock.ROBOT}")
    return make_config(**values)


def camera_config(
    names: Iterable[str], sizes: Given, look: Look | None = None, *, small: bool = False
) -> CameraConfig | None:
    """Return the cameras of `--cameras` and `--image.*`, None for none; `UsageError` for a wrong value."""
    chosen, sizes = tuple(names), (SMALL if small else {}) | sizes
    return CameraConfig(chosen, **sizes, look=look or Look()) if chosen else None


def image_given(*, small: bool = False) -> Any:
    """Return the field of `--image.*`. small: as a policy learns from pictures."""
    return given(CameraConfig, only=("height", "width"), defaults=SMALL if small else None)


@dataclass
class EngineOptions:
    """Workers that run episodes."""

    engine: Literal["local", "ray"] = option(
        "local", "where episodes run: local processes, or a Ray cluster (RAY_ADDRESS, or one started here)", free=True
    )
    workers: int | None = option(
        None, "processes, or tasks at once on Ray; by default one per core", at_least=1, free=True
    )

    def open(self) -> Engine:
        """Return the engine, to use as a context manager."""
        from manip_il.collect.workers import Engine

        return Engine(self.workers, self.engine)


@dataclass
class TrialGroup:
    """`--eval.*` of policies that are compared."""

    n_episodes: int = option(500, "test episodes, the same for both sides", at_least=1)


def seed_option() -> Any:
    """Return the field of `--seed`."""
    return option(0, "shifts every random stream, 0 to 1000", at_least=0, at_most=1000)


def processes_option() -> Any:
    """Return the field of `--workers` of commands that run on this machine alone."""
    return option(None, "processes; by default one per core", at_least=1, free=True)


def trust_option() -> Any:
    """Return the field of `--trust`, which only the command line may set."""
    return option(False, _TRUST, command_line_only=True, free=True)


def vary_option() -> Any:
    """Return the field of `--vary`."""
    return option(list, f"how worlds differ from episode to episode: {_CONDITIONS}, or YAMLs of ranges")


def suite_option() -> Any:
    """Return the field of `--suite`."""
    names = f"nominal, disturbed, randomised, all; one condition of {_CONDITIONS}; or a YAML of ranges"
    return option("nominal", names, check=_require_suite)


def policy_option() -> Any:
    """Return the field of a policy's path."""
    return option(None, "a checkpoint or a run", check=find_policy)


def _require_suite(suite: str) -> None:
    from manip_il.evaluation.suites import require_suite  # here, as help needs no numpy

    require_suite(suite)


def own_names(robot: str, task: str, shape: str = "") -> str:
    """Return the options, after a space, that a next command needs for a robot, a task and a mesh that do not ship."""
    from manip_il.sim.mesh import mesh_path, nameable  # here, as help needs no numpy

    given = [] if robot in (*ROBOTS, stock.ROBOT) else [f"--robot.type={_arm(robot)}"]
    ships = task.partition(":")[0] in (*NAMES, *stock.STOCK, "unknown")
    given += [] if ships else [f"--task.type={_file(task, '.py')}"]
    given += [f"--task.object={nameable(shape)}"] if mesh_path(shape) else []
    return "".join(f" {one}" for one in given)


def _arm(robot: str) -> str:
    """Return the robot that LeRobot records under this type, else the robot's file."""
    from manip_il.robots.table import get_robot  # here, as help needs no robot

    types = {servos.robot_type: name for name in ROBOTS if (servos := get_robot(name).lerobot) is not None}
    return types.get(robot) or _file(robot, ".yaml")


def _file(name: str, suffix: str) -> str:
    return name if Path(name).suffix else name + suffix
