"""Options that several commands share: groups, and base classes of the commands' options."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il.cli.parsing import Given, given
from manip_il.option import keyword, option
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.worlds.config import WORLDS, EnvConfig
from manip_il.worlds.table import env_spec

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine

# by default those of the policy
OF_POLICY: Given = dict.fromkeys(("robot", "task", "control_hz", "object"))
SMALL: Given = {"height": 96, "width": 96}  # picture size for policies [pixels]
_CONDITIONS = (
    "object, dynamics, knocked, sensing, random_actions; with cameras also view, clutter, late"
)

DATASET = "a LeRobot v3.0 dataset"


def default_cameras(env: EnvConfig) -> tuple[str, ...]:
    """Return the cameras used if none are named.

    Raise `Unable` if no camera draws the environment.
    """
    spec = env_spec(env)
    spec.require("drawn", "it has no cameras")
    return spec.default_cameras


@dataclass(frozen=True)
class DatasetRoots:
    """`--dataset.*`: the training data."""

    root: list[Path] = option(MISSING, DATASET, free=True)


@dataclass(frozen=True)
class OfDataset:
    """Options of a command on one dataset."""

    dataset: Path = option(MISSING, DATASET, positional=True)


def worker_count(default: int | None = None) -> Any:
    """Return the field of a number of workers."""
    about = "number of processes, or of concurrent tasks on Ray; none (null): one per core"
    return keyword(default, about, at_least=1, free=True)


Published = Literal["smolvla", "pi05", "groot"]  # models that are fine-tuned on datasets


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """Options of worker processes on this machine or a Ray cluster."""

    workers: int | None = worker_count()
    engine: Literal["local", "ray"] = option(
        "local",
        "where episodes run: local processes, or a Ray cluster (RAY_ADDRESS, else on this machine)",
        free=True,
    )

    def open_engine(self) -> Engine:
        """Return the engine, to use as a context manager."""
        from manip_il.collect.workers import Engine

        return Engine(self.workers, self.engine)


@dataclass(frozen=True, kw_only=True)
class Tested:
    """Options of a command that runs episodes under test conditions."""

    suite: str = option(
        "nominal",
        f"test conditions: nominal, disturbed, randomised, all, a single one ({_CONDITIONS}) or a"
        " YAML file of ranges",
    )


@dataclass(frozen=True, kw_only=True)
class Trusting:
    """Options of a command that loads checkpoints."""

    trust: bool = option(
        False,
        "load the models and run the code that a checkpoint names (smolvla, pi0, groot, ...): only"
        " for sources that you trust; cannot be set in a file",
        command_line_only=True,
        free=True,
    )


_THEIR_CAMERAS = "".join(
    f"for {name}: {', '.join(world.cameras)}; " for name, world in WORLDS.items() if world.cameras
)


@dataclass(frozen=True, kw_only=True)
class Pictured:
    """Options of a command that renders pictures."""

    cameras: list[str] = option(
        list,
        f"any of {', '.join(CAMERAS)}; {_THEIR_CAMERAS}by default all if pictures are needed, else"
        " none",
    )
    image: Given = given(CameraConfig)

    def camera_config(self, env: EnvConfig, look: Look | None = None) -> CameraConfig:
        """Return the cameras, by default those of `default_cameras`.

        `UsageError` for an invalid value.
        """
        cameras = CameraConfig(
            tuple(self.cameras) or default_cameras(env), **self.image, look=look or Look()
        )
        env_spec(env).require_cameras(cameras)
        return cameras


@dataclass(frozen=True)
class PolicyGroup:
    """`--policy.*`: the policy that drives."""

    path: Path | None = option(None, "a checkpoint or a run")
    type: Literal["expert", "random"] | None = option(None, "who drives instead of a checkpoint")


@dataclass(frozen=True, kw_only=True)
class Varied(Pictured):
    """Options of a command that randomises worlds and renders pictures."""

    vary: list[str] = option(
        list, f"what to randomise between episodes: {_CONDITIONS}; or YAML files of ranges"
    )
