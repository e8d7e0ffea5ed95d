"""Options that several commands share, each declared once: groups, and classes that commands inherit from."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il.cli.options import Given, Open, given
from manip_il.evaluation.policy_folder import find_policy
from manip_il.option import option
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.tasks.config import EnvConfig, make_config
from manip_il.tasks.stock import table as stock

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine
    from manip_il.learn.checkpoint import Origin

OF_POLICY: Given = dict.fromkeys(("robot", "task", "control_hz", "object"))  # an environment is as a policy has it
SMALL: Given = {"height": 96, "width": 96}  # of a picture that a policy learns from [pixels]
_CONDITIONS = "object, dynamics, knocked, sensing, random_actions; with cameras view, clutter, late"

DATASET = "a LeRobot v3.0 dataset"


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


def default_cameras(env: EnvConfig) -> tuple[str, ...]:
    """Return the cameras that are taken if none are named: all, of a stock robot the first."""
    return (stock.ROBOTS[env.robot].cameras[:1] if env.robot in stock.ROBOTS else ()) or CAMERAS


def start_policy(settings: Open) -> Open:
    """Return `--policy.*` of what is fitted, with the `pretrained_model` folder that its `path` means."""
    if "path" not in settings:
        return settings
    return settings | {"path": str(find_policy(Path(str(settings["path"])).expanduser()))}


@dataclass(frozen=True)
class Demonstrations:
    """`--dataset.*` of what is learnt from."""

    root: list[Path] = option(MISSING, DATASET, exists="datasets/", free=True)


@dataclass(frozen=True)
class OfDataset:
    """Command on one dataset."""

    dataset: Path = option(MISSING, DATASET, exists="datasets/", positional=True)


@dataclass(frozen=True)
class PolicyGroup:
    """`--policy.*` of what drives."""

    path: Path | None = option(None, "a checkpoint or a run")


@dataclass(frozen=True)
class Workers:
    """Workers that run episodes or edits."""

    workers: int | None = option(
        None, "processes, or tasks at once on Ray; by default one per core", at_least=1, free=True
    )

    def open(self) -> Engine:
        """Return the engine, to use as a context manager."""
        from manip_il.collect.workers import Engine

        return Engine(self.workers)


@dataclass(frozen=True)
class EngineOptions(Workers):
    """Workers of this machine, or of a Ray cluster."""

    engine: Literal["local", "ray"] = option(
        "local", "where episodes run: local processes, or a Ray cluster (RAY_ADDRESS, or one started here)", free=True
    )

    def open(self) -> Engine:
        """Return the engine, to use as a context manager."""
        from manip_il.collect.workers import Engine

        return Engine(self.workers, self.engine)


@dataclass(frozen=True)
class TrialGroup:
    """`--eval.*`: the episodes of a test."""

    n_episodes: int | None = option(
        None, "test episodes; by default 100 for eval, and with --until_width at most 10,000", at_least=1, grows=True
    )


@dataclass(frozen=True, kw_only=True)
class Tested:
    """Command that runs under conditions."""

    suite: str = option(
        "nominal",
        f"nominal, disturbed, randomised, all; one condition of {_CONDITIONS}; or a YAML of ranges",
    )


@dataclass(frozen=True, kw_only=True)
class Trusting:
    """Command that loads checkpoints from anywhere."""

    trust: bool = option(
        False,
        "load models, and run code, that a checkpoint names (smolvla, pi0, groot, ...): only for sources that you "
        "trust; only on the command line",
        command_line_only=True,
        free=True,
    )


@dataclass(frozen=True, kw_only=True)
class Pictured:
    """Command that makes pictures."""

    cameras: list[str] = option(
        list,
        f"any of {', '.join(CAMERAS)}, of aloha top, angle, front_close, left_wrist, right_wrist, ...; "
        "by default all for pictures, else none",
    )
    image: Given = given(CameraConfig)

    def camera_config(self, env: EnvConfig, look: Look | None = None) -> CameraConfig:
        """Return the cameras, by default those of `default_cameras`; `UsageError` for a wrong value."""
        return CameraConfig(tuple(self.cameras) or default_cameras(env), **self.image, look=look or Look())


@dataclass(frozen=True, kw_only=True)
class Varied(Pictured):
    """Command that makes worlds that differ, and pictures of them."""

    vary: list[str] = option(list, f"how worlds differ from one to the next: {_CONDITIONS}, or YAMLs of ranges")
