"""The parts of a round of imitation: its rollouts, and the policy that is fitted to those of all rounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.algorithms.config import RunConfig
from manip_il.data.dataset import Dataset
from manip_il.learn.fit_config import LEROBOT, FitConfig
from manip_il.seeding import stream_base

F64 = NDArray[np.float64]
CHUNK_STEPS = 20_000  # of a round, for LeRobot's policies, if none are given


@dataclass(frozen=True)
class Rollouts:
    """One round's episodes. dataset: None if the expert gave no label. beta: the expert's share of the steps.

    labels: sound ones. queries: states in which the expert was queried. episodes, successes: of the rollouts. steps:
    control steps simulated.
    """

    round: int
    dataset: Path | None = None
    beta: float = 1.0
    labels: int = 0
    queries: int = 0
    episodes: int = 0
    successes: int = 0
    steps: int = 0


@dataclass(frozen=True)
class Fitted:
    """A round's policy. members: the `pretrained_model` folders of an ensemble, of which the first drives.

    trust: whether models that they name may be loaded.
    """

    round: int
    members: tuple[Path, ...]
    trust: bool = False

    @property
    def path(self) -> Path:
        """Return the checkpoint of the policy that drives."""
        return self.members[0]


def round_folder(folder: Path, round_: int) -> Path:
    """Return the folder of a round: its journals, dataset, policy and evaluation."""
    return folder / f"round_{round_:03d}"


def fit_round(
    config: RunConfig,
    roots: Sequence[Path],
    folder: Path,
    fit: FitConfig,
    on_log: Callable[[dict[str, Any]], None] | None = None,
) -> Path:
    """Fit, or go on with fitting, a policy to datasets; return the checkpoint's `pretrained_model`.

    on_log: sees the metrics, {} at a step without.
    """
    from manip_il.learn.sources import Sources
    from manip_il.learn.train import Trainer  # torch stays out of what only rolls out

    trainer = Trainer(
        Sources(tuple(map(Dataset.open, roots))),
        fit,
        folder,
        resume=True,
    )
    return trainer.fit(on_log)


def round_fit(config: RunConfig, init_from: Path | None = None, member: int = 0) -> FitConfig:
    """Return the options of one round's fit. init_from: where a warm one starts from.

    Any other starts from the run's start policy, if there is one. member: of the ensemble, each from a seed of its own.
    """
    steps = config.fit.steps or (CHUNK_STEPS if config.fit.defaults is LEROBOT else None)
    if init_from is not None:
        steps = config.refit_steps or steps
    seed = stream_base("training", config.seed) + member
    return replace(config.fit, steps=steps, seed=seed, init_from=init_from or config.start)
