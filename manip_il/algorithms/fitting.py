"""One round's fit: a policy of any kind to the labels of all rounds so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.algorithms import sampling
from manip_il.algorithms.config import RunConfig
from manip_il.data.lerobot_io import read_tables
from manip_il.engine.environments import env_fingerprint, env_spec
from manip_il.learn.columns import LEARNING_COLUMNS
from manip_il.learn.fit_config import FitConfig
from manip_il.seeding import stream_base
from manip_il.sim.scene import build_scene

F64 = NDArray[np.float64]
Table = dict[str, NDArray[Any]]
OnLog = Callable[[dict[str, Any]], None]
CHUNK_STEPS = 20_000  # of a round, for policies other than the mlp, where none are given


def fit_round(
    config: RunConfig, roots: Sequence[Path], folder: Path, init_from: Path | None, on_log: OnLog, member: int
) -> Path:
    """Fit, or go on with fitting, a policy to datasets; the checkpoint's `pretrained_model`.

    init_from: start there (see `refit`). on_log: sees the metrics, {} at a step without. member: of the ensemble,
    each from a seed of its own.
    """
    fit = round_fit(config, init_from is not None)
    if fit.is_mlp:
        table = read_tables(roots, LEARNING_COLUMNS)
        return fit_table(config, table, folder, init_from, on_log, member, frame_weights(config, roots))
    from manip_il.learn.checkpoint import CheckpointMeta  # torch stays out of what only rolls out
    from manip_il.learn.fit_policy import fit_policy

    wanted = fit.other(stream_base("training", config.seed) + member, init_from)
    spec, fingerprint = env_spec(config.env, config.cameras), env_fingerprint(config.env, config.cameras)
    look = asdict(config.cameras.look) if config.cameras is not None else None
    meta = CheckpointMeta.of(spec, fingerprint, wanted.what_changes_the_weights(), wanted.observation, look)
    weights = frame_weights(config, roots)
    return fit_policy(roots, wanted, folder, meta=meta, on_step=on_log, resume=True, weights=weights)


def fit_table(
    config: RunConfig,
    table: Table,
    folder: Path,
    init_from: Path | None = None,
    on_log: OnLog | None = None,
    member: int = 0,
    weights: F64 | None = None,
) -> Path:
    """Fit an mlp to `LEARNING_COLUMNS`, as every round's is fitted."""
    from manip_il.learn.train import fit

    wanted = round_fit(config, init_from is not None).mlp(stream_base("training", config.seed) + member, init_from)
    spec, fingerprint = env_spec(config.env), env_fingerprint(config.env)
    return fit(table, wanted, folder, spec=spec, fingerprint=fingerprint, on_log=on_log, resume=True, weights=weights)


def round_fit(config: RunConfig, warm: bool) -> FitConfig:
    """Return the options of one round's fit."""
    fit = config.fit
    if fit.steps is None and not fit.is_mlp:
        fit = replace(fit, steps=CHUNK_STEPS)
    return replace(fit, steps=config.refit_steps) if warm and config.refit_steps is not None else fit


def frame_weights(config: RunConfig, roots: Sequence[Path]) -> F64 | None:
    """Return how often each frame of the datasets is drawn, (N,); None where all are alike."""
    if config.sampling.is_even:
        return None
    scale = build_scene(config.env.robot, config.env.task).actions.scale
    return config.sampling.weights(read_tables(roots, sampling.COLUMNS), scale)
