"""Options that several commands share: groups, and base classes of the commands' options."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il.cli.options import Given, Open, given
from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.option import option
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.sim.shape import MESH
from manip_il.tasks.config import EnvConfig, complete
from manip_il.tasks.stock import table as stock

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine
    from manip_il.learn.checkpoint import Origin

OF_POLICY: Given = dict.fromkeys(("robot", "task", "control_hz", "object"))  # by default those of the policy
SMALL: Given = {"height": 96, "width": 96}  # picture size for policies [pixels]
_CONDITIONS = "object, dynamics, knocked, sensing, random_actions; with cameras also view, clutter, late"

DATASET = "a LeRobot v3.0 dataset"


def env_config(env: Given, origin: Origin | None = None) -> EnvConfig:
    """Return the environment: each value as given, else as in the policy's checkpoint, else the default.

    Raises `UnknownName` for an unknown robot or task, `UsageError` for any other invalid value.
    """
    from manip_il.data.dataset import UNKNOWN_TASK

    values = {name: value for name, value in env.items() if value is not None}
    if origin is not None:
        if lacking := [one for one in own_files(origin.robot, origin.task) if one[2:].partition(".")[0] not in values]:
            raise UsageError(
                f"the policy is for {origin.robot} {origin.task}, of a file of your own; give {' '.join(lacking)}"
            )
        of_policy: dict[str, Any] = {"robot": origin.robot, "control_hz": origin.fps}
        of_policy |= {} if origin.task == UNKNOWN_TASK else {"task": origin.task}
        values = of_policy | values
        if values.get("task") == origin.task:
            values.setdefault("object", origin.object)
    return complete(EnvConfig(**values))


def own_files(robot: str, task: str, shape: str = "") -> list[str]:
    """Return the options, with FILE for a path, that commands need for what a dataset or a policy only names.

    robot, task, shape: as in a `RobotTaskSpec`.
    """
    from manip_il.data.dataset import UNKNOWN_TASK
    from manip_il.robots.table import is_robot
    from manip_il.tasks.table import is_task

    if robot in stock.ROBOTS or task == UNKNOWN_TASK:
        return []
    robots = [] if is_robot(robot) else ["--robot.type=FILE.yaml"]
    meshes = ["--task.object=mesh:FILE:LENGTH"] if shape.startswith(MESH) else []
    return [*robots, *([] if is_task(task) else ["--task.type=FILE.py"]), *meshes]


def env_options(env: EnvConfig) -> list[str]:
    """Return those options of an environment that no dataset or policy stores: paths, and changed limits."""
    try:
        usual = complete(replace(env, tolerance=0.0, horizon=0, success_steps=0))
    except ManipError:  # the user's file was edited or deleted meanwhile
        usual = env
    limits = [name for name in ("tolerance", "horizon", "success_steps") if getattr(env, name) != getattr(usual, name)]
    return path_options(env) + [f"--env.{name}={getattr(env, name):g}" for name in limits]


def path_options(env: EnvConfig) -> list[str]:
    """Return the options that name files of the user's own, which no dataset, policy or result stores."""
    named = {"--robot.type": env.robot, "--task.type": env.task, "--task.object": env.object}
    return [f"{name}={path}" for name, path in named.items() if isinstance(path, Path)]


def default_cameras(env: EnvConfig) -> tuple[str, ...]:
    """Return the cameras used if none are named: all, but for a stock robot only its first."""
    return (stock.ROBOTS[env.robot].cameras[:1] if env.robot in stock.ROBOTS else ()) or CAMERAS


def start_policy(settings: Open) -> Open:
    """Return the `--policy.*` options of a fit, with `path` resolved to its `pretrained_model` folder."""
    if "path" not in settings:
        return settings
    return settings | {"path": str(find_policy(Path(str(settings["path"])).expanduser()))}


@dataclass(frozen=True)
class DatasetRoots:
    """`--dataset.*`: the training data."""

    root: list[Path] = option(MISSING, DATASET, exists="datasets/", free=True)


@dataclass(frozen=True)
class OfDataset:
    """Options of a command on one dataset."""

    dataset: Path = option(MISSING, DATASET, exists="datasets/", positional=True)


@dataclass(frozen=True)
class EngineOptions:
    """Options of worker processes on this machine or a Ray cluster."""

    workers: int | None = option(
        None, "number of processes, or of concurrent tasks on Ray; none (null): one per core", at_least=1, free=True
    )
    engine: Literal["local", "ray"] = option(
        "local", "where episodes run: local processes, or a Ray cluster (RAY_ADDRESS, else on this machine)", free=True
    )

    def open(self) -> Engine:
        """Return the engine, to use as a context manager."""
        from manip_il.collect.workers import Engine

        return Engine(self.workers, self.engine)


@dataclass(frozen=True, kw_only=True)
class Tested:
    """Options of a command that runs episodes under test conditions."""

    suite: str = option(
        "nominal",
        f"test conditions: nominal, disturbed, randomised, all, a single one ({_CONDITIONS}) or a YAML file of ranges",
    )


@dataclass(frozen=True, kw_only=True)
class Trusting:
    """Options of a command that loads checkpoints."""

    trust: bool = option(
        False,
        "load the models and run the code that a checkpoint names (smolvla, pi0, groot, ...): only for sources that "
        "you trust; cannot be set in a file",
        command_line_only=True,
        free=True,
    )


@dataclass(frozen=True, kw_only=True)
class Pictured:
    """Options of a command that renders pictures."""

    cameras: list[str] = option(
        list,
        f"any of {', '.join(CAMERAS)}; for aloha: top, angle, front_close, left_wrist, right_wrist, ...; "
        "by default all if pictures are needed, else none",
    )
    image: Given = given(CameraConfig)

    def camera_config(self, env: EnvConfig, look: Look | None = None) -> CameraConfig:
        """Return the cameras, by default those of `default_cameras`; `UsageError` for an invalid value."""
        return CameraConfig(tuple(self.cameras) or default_cameras(env), **self.image, look=look or Look())


@dataclass(frozen=True, kw_only=True)
class Varied(Pictured):
    """Options of a command that randomises worlds and renders pictures."""

    vary: list[str] = option(list, f"what to randomise between episodes: {_CONDITIONS}; or YAML files of ranges")
