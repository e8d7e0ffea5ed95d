"""Options that several commands share, each declared once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il.cli.options import Given, Open, given
from manip_il.errors import UsageError
from manip_il.evaluation.policy_folder import find_policy, hub_hint
from manip_il.option import option
from manip_il.robots import ROBOTS
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.tasks import NAMES
from manip_il.tasks.config import EnvConfig, make_config
from manip_il.tasks.stock import table as stock

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine
    from manip_il.learn.checkpoint import Origin

REWARD = "a reward of manip-il reward fit"
SMALL_SIDE = 96  # of a picture that a policy learns from [pixels]
SMALL = {"height": SMALL_SIDE, "width": SMALL_SIDE}
_POLICYS = ("robot", "task", "control_hz", "object")  # what a policy says of its environment
_TRUST = (
    "load models, and run code, that a checkpoint names (smolvla, pi0, groot, ...): only for sources that you trust; "
    "only on the command line"
)
_CONDITIONS = "object, dynamics, knocked, sensing, random_actions; with cameras view, clutter, late"
CAMERAS_HELP = "any of front, side, wrist, of aloha top, angle, front_close, left_wrist, right_wrist, ..."
OWN_ROBOT_HELP = "its YAML, if the dataset's robot does not ship"
OWN_TASK_HELP = "its Python file, if the dataset's task does not ship"
OWN_OBJECT_HELP = "mesh:FILE:LENGTH as in the recording, if the dataset's object is a mesh"


def env_given(*, of_policy: bool = False, robot: str = EnvConfig.robot) -> Any:
    """Return the field of `--robot.*`, `--task.*`, `--env.*`. of_policy: what is not given is as the policy has it."""
    return given(EnvConfig, defaults=dict.fromkeys(_POLICYS) if of_policy else {"robot": robot})


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
    return make_config(**values)


def camera_config(
    names: Iterable[str], sizes: Given, look: Look | None = None, *, robot: str = "", small: bool = False
) -> CameraConfig:
    """Return the cameras of `--cameras`, by default all, and `--image.*`; `UsageError` for a wrong value.

    robot: the one that they look at; of a stock one, the first is taken by default.
    """
    sizes = (SMALL if small else {}) | sizes
    known = stock.ROBOTS[robot].cameras[:1] if robot in stock.ROBOTS else CAMERAS
    return CameraConfig(tuple(names) or known or CAMERAS, **sizes, look=look or Look())


def image_given(*, small: bool = False) -> Any:
    """Return the field of `--image.*`. small: as a policy learns from pictures."""
    return given(CameraConfig, only=("height", "width"), defaults=SMALL if small else None)


def exists(what: str) -> Callable[[Path], None]:
    """Return the check of a path's option: it raises `UsageError` if nothing is there. what: is expected."""

    def check(path: Path) -> None:
        if not path.exists():
            raise UsageError(f"{path} does not exist; expected {what}")

    return check


def require_dataset(root: Path) -> None:
    """Raise `UsageError` unless `root` is a folder with a LeRobot dataset's `meta/info.json`."""
    if not root.exists():
        hint = hub_hint(root, "datasets/")
        raise UsageError(f"{root} does not exist; expected the folder of a LeRobot dataset{hint}")
    if not (root / "meta" / "info.json").is_file():
        raise UsageError(f"{root} is not a LeRobot dataset: it has no meta/info.json")


def require_eval(path: Path) -> None:
    """Raise `UsageError` unless `path` is a file, an `eval.json`, or a folder that holds one."""
    if not path.is_file() and not (path / "eval.json").is_file():
        problem = "holds no eval.json" if path.exists() else "does not exist; expected an eval.json"
        raise UsageError(f"{path} {problem} of manip-il eval; a policy to measure is given as --policy.path={path}")


def start_policy(settings: Open) -> Open:
    """Return `--policy.*` of what is fitted, with the `pretrained_model` folder that its `path` means."""
    if "path" not in settings:
        return settings
    return settings | {"path": str(find_policy(Path(str(settings["path"])).expanduser()))}


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


def _require_suite(suite: str) -> None:
    from manip_il.evaluation.suites import require_suite  # here, as help needs no numpy

    require_suite(suite)


seed_option = partial(option, 0, "shifts every random stream, 0 to 1000", at_least=0, at_most=1000)
processes_option = partial(option, None, "processes; by default one per core", at_least=1, free=True)
trust_option = partial(option, False, _TRUST, command_line_only=True, free=True)
vary_option = partial(option, list, f"how worlds differ from episode to episode: {_CONDITIONS}, or YAMLs of ranges")
suite_option = partial(
    option,
    "nominal",
    f"nominal, disturbed, randomised, all; one condition of {_CONDITIONS}; or a YAML of ranges",
    check=_require_suite,
)
policy_option = partial(option, None, "a checkpoint or a run", check=find_policy)


def own_names(robot: str, task: str, shape: str = "") -> str:
    """Return the options, after a space, that a next command needs for a robot, a task and a mesh that do not ship."""
    from manip_il.robots.table import get_robot  # here, as help needs no robot and no numpy
    from manip_il.sim.mesh import mesh_path, nameable

    own = ""
    if robot not in (*ROBOTS, *stock.ROBOTS):
        arms = {servos.robot_type: name for name in ROBOTS if (servos := get_robot(name).lerobot) is not None}
        own = f" --robot.type={arms.get(robot) or Path(robot).with_suffix('.yaml')}"  # LeRobot has names of its own
    if task.partition(":")[0] not in (*NAMES, *stock.STOCK, *stock.ALOHA_TASKS, "unknown"):
        own += f" --task.type={Path(task).with_suffix('.py')}"
    return own + (f" --task.object={nameable(shape)}" if mesh_path(shape) else "")
