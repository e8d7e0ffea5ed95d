"""One round's fit: a policy of any kind to the labels of all rounds so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.algorithms.config import RunConfig
from manip_il.collect.environments import env_actions, env_fingerprint, env_spec
from manip_il.data.dataset import Dataset, joined_columns
from manip_il.data.schema import ACTION, ACTOR, EXECUTED_ACTION, ROUND
from manip_il.learn.fit_config import LEROBOT, FitConfig
from manip_il.seeding import stream_base

F64 = NDArray[np.float64]
COLUMNS = (ROUND, ACTOR, EXECUTED_ACTION, ACTION)  # what `Sampling.weights` reads
OnLog = Callable[[dict[str, Any]], None]
CHUNK_STEPS = 20_000  # of a round, for LeRobot's policies, where none are given


def fit_round(
    config: RunConfig,
    roots: Sequence[Path],
    folder: Path,
    init_from: Path | None = None,
    on_log: OnLog | None = None,
    member: int = 0,
    weights: F64 | None = None,
) -> Path:
    """Fit, or go on with fitting, a policy to datasets; return the checkpoint's `pretrained_model`.

    init_from: start there (see `refit`). on_log: sees the metrics, {} at a step without. member: of the ensemble,
    each from a seed of its own. weights: how often each frame is drawn, (N,); by default as the run's `sampling` says.
    """
    from manip_il.learn.sources import Sources
    from manip_il.learn.train import Trainer  # torch stays out of what only rolls out

    trainer = Trainer(
        Sources(tuple(map(Dataset.open, roots))),
        round_fit(config, init_from, member),
        folder,
        spec=env_spec(config.env, config.cameras),
        fingerprint=env_fingerprint(config.env, config.cameras),
        look=asdict(config.cameras.look) if config.cameras is not None else None,
        resume=True,
        weights=frame_weights(config, roots) if weights is None else weights,
    )
    return trainer.fit(on_log)


def round_fit(config: RunConfig, init_from: Path | None = None, member: int = 0) -> FitConfig:
    """Return the options of one round's fit. init_from: where a warm one starts from. member: of the ensemble.

    Any other starts from the run's start policy, where there is one.
    """
    steps = config.fit.steps or (CHUNK_STEPS if config.fit.defaults is LEROBOT else None)
    if init_from is not None:
        steps = config.refit_steps or steps
    seed = stream_base("training", config.seed) + member
    return replace(config.fit, steps=steps, seed=seed, init_from=init_from or config.start)


def frame_weights(config: RunConfig, roots: Sequence[Path]) -> F64 | None:
    """Return how often each frame of the datasets is drawn, (N,); None where all are alike."""
    if config.sampling.is_even:
        return None
    scale = env_actions(config.env).scale
    return config.sampling.weights(joined_columns(roots, COLUMNS), scale)
