"""Weights of samples from progress, as LeRobot's RA-BC has them (`lerobot.rewards.sarm.rabc`, Chen et al. 2025).

    delta_t = progress_(t + ahead) - progress_t     within the episode; beyond its end, its last frame's progress
    w_t = 1 where delta_t > KAPPA, 0 where delta_t < 0, between clip((delta_t - (m - 2 s)) / (4 s + EPSILON), 0, 1)

with the mean m, not below 0, and standard deviation s of all deltas (equations 8 and 9 of arXiv:2509.25358). A frame
without progress has no delta and weighs 1. LeRobot multiplies losses with these weights, normalised in each batch; here
samples are drawn in proportion to them, which follows the same gradient without computing what has no weight.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manip_il.data.lerobot_layout import EPISODE_INDEX, INDEX
from manip_il.data.parquet_files import floats, integers, read_file
from manip_il.errors import ManipError, MismatchError

F64, I64 = NDArray[np.float64], NDArray[np.int64]
PROGRESS = "progress_sparse"
KAPPA, EPSILON, FALLBACK = 0.01, 1e-6, 1.0  # LeRobot's


def read_progress(path: Path, episodes: I64) -> F64:
    """Return the progress of every frame of a dataset, (N,), NaN where the file has none.

    episodes: the dataset's `episode_index`, (N,). Raises `ManipError` for a file that is no such table, and
    `MismatchError` for one of another dataset.
    """
    table = read_file(path, [INDEX, EPISODE_INDEX, PROGRESS])
    try:
        index, episode, progress = integers(table, INDEX), integers(table, EPISODE_INDEX), floats(table, PROGRESS)
    except ValueError as error:
        raise ManipError(f"{path} is no file of weights: {error}") from error
    if len(np.unique(index)) < len(index) or (len(index) and not 0 <= index.min() <= index.max() < len(episodes)):
        raise MismatchError("frames", str(path), f"{len(index)} up to {index.max()}", "the dataset", len(episodes))
    if len(index) != len(episodes) or (episodes[index] != episode).any():
        raise MismatchError("episodes", str(path), f"{len(index)} frames", "the dataset", f"{len(episodes)} frames")
    found = np.full(len(episodes), np.nan)
    found[index] = progress
    if np.isinf(found).any():
        raise ManipError(f"{path}: {PROGRESS} of frame {int(np.argmax(np.isinf(found)))} is infinite")
    return found


def rabc_weights(progress: F64, episodes: I64, ahead: int) -> F64:
    """Return the weight of every frame, (N,), of progress (N,) in episodes (N,); ahead: frames that an action reaches.

    Raises `ManipError` where every frame weighs 0.
    """
    last = np.flatnonzero(np.diff(episodes, append=-1))
    end = last[np.searchsorted(last, np.arange(len(episodes)))]
    delta = progress[np.minimum(np.arange(len(episodes)) + ahead, end)] - progress
    known = delta[~np.isnan(delta)]
    mean = max(float(known.mean()), 0.0) if len(known) else 0.0
    spread = max(float(known.std()), EPSILON) if len(known) else EPSILON
    soft = np.clip((delta - (mean - 2 * spread)) / (4 * spread + EPSILON), 0.0, 1.0)
    weights = np.where(delta > KAPPA, 1.0, np.where(delta >= 0, soft, 0.0))
    weights[np.isnan(delta)] = FALLBACK
    if not weights.any():
        raise ManipError(f"all {len(weights)} frames weigh 0: progress falls from each of them; nothing to learn from")
    return weights
