"""DART: noise for the expert that looks like the learner's errors (Laskey et al., CoRL 2017)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manip_il.data.lerobot_io import read_table
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE
from manip_il.errors import ManipError

F64 = NDArray[np.float64]
EPISODE = "episode_index"


def fitted_noise(policy: Path, root: Path, *, trust: bool = False) -> tuple[tuple[float, ...], ...]:
    """The covariance (n, n) of learner minus expert over a dataset of the expert's, for the next round's noise.

    Maximum likelihood for a Gaussian with mean zero, as the paper fits it. Best on data that the policy has not
    learnt from, or its errors are taken for smaller than they are. trust: see `LearnedPolicy.load`. Raises `ManipError`
    without a sound label.
    """
    from manip_il.learn.policy import LearnedPolicy

    table = read_table(root, (STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID, EPISODE))
    learner = LearnedPolicy.load(policy, trust=trust)
    errors: list[F64] = []
    for rows in _side_by_side(table[EPISODE].reshape(-1)):  # a policy with a memory is asked in the order of time
        actions = learner.act(table[STATE][rows], table[ENVIRONMENT_STATE][rows], {}, table[EPISODE][rows].tolist())
        errors.append((actions - table[ACTION][rows])[table[LABEL_VALID][rows].reshape(-1) != 0])
    off = np.concatenate(errors)
    if not len(off):
        raise ManipError(f"{root} holds no valid label to compare the policy with")
    return tuple(map(tuple, (off.T @ off / len(off)).tolist()))


def _side_by_side(episodes: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows of the first frame of every episode, of the second, and so on."""
    starts = np.flatnonzero(np.diff(episodes, prepend=episodes[0] - 1))
    steps = np.arange(len(episodes)) - np.repeat(starts, np.diff(np.append(starts, len(episodes))))
    return [np.flatnonzero(steps == step) for step in range(int(steps.max()) + 1)]
