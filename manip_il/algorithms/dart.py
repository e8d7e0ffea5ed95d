"""DART: demonstrations under noise for the expert that looks like the learner's errors (Laskey et al., CoRL 2017)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.algorithms.rounds import Noise, RoundResult, noisy_expert
from manip_il.errors import ManipError

if TYPE_CHECKING:  # the algorithms are read for help, without numpy
    import numpy as np
    from numpy.typing import NDArray

    from manip_il.algorithms.config import RunConfig
    from manip_il.algorithms.run import Run

    F64 = NDArray[np.float64]


def dart(run: Run, c: RunConfig) -> Iterator[RoundResult]:
    """Yield every round: demonstrate under noise like the learner's errors, aggregate, refit, validate."""
    data = [run.demonstrations(c.demonstrations)]
    policy = run.fit(data)
    yield run.validate(policy)
    for i in range(1, c.rounds + 1):
        noise = fitted_noise(policy.path, run.held_out(), trust=c.fit.trust)
        data.append(run.rollouts(i, noisy_expert(noise)))
        policy = run.fit(data)
        yield run.validate(policy)


def fitted_noise(policy: Path, root: Path, *, trust: bool = False) -> Noise:
    """Return the covariance (n, n) of learner minus expert over a dataset of the expert's, for a round's noise.

    Maximum likelihood for a Gaussian with mean zero, as the paper fits it. Best on data that the policy has not
    learnt from, or its errors are taken for smaller than they are. trust: see `LearnedPolicy.load`. Raises `ManipError`
    without a sound label.
    """
    import numpy as np

    from manip_il.data.dataset import Dataset
    from manip_il.data.lerobot_layout import EPISODE_INDEX
    from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE
    from manip_il.learn.policy import LearnedPolicy

    table = Dataset.open(root).columns((STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID, EPISODE_INDEX))
    learner = LearnedPolicy.load(policy, trust=trust)
    errors: list[F64] = []
    for rows in _rows_by_step(table[EPISODE_INDEX].reshape(-1)):  # in the order of time, for a policy with a memory
        actions = learner.act(
            table[STATE][rows], table[ENVIRONMENT_STATE][rows], {}, table[EPISODE_INDEX][rows].tolist()
        )
        errors.append((actions - table[ACTION][rows])[table[LABEL_VALID][rows].reshape(-1) != 0])
    off = np.concatenate(errors)
    if not len(off):
        raise ManipError(f"{root} holds no valid label to compare the policy with")
    return tuple(map(tuple, (off.T @ off / len(off)).tolist()))


def _rows_by_step(episodes: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Rows (R,) of the first frame of every episode, of the second, and so on."""
    import numpy as np

    starts = np.flatnonzero(np.diff(episodes, prepend=episodes[0] - 1))
    steps = np.arange(len(episodes)) - np.repeat(starts, np.diff(np.append(starts, len(episodes))))
    return [np.flatnonzero(steps == step) for step in range(int(steps.max()) + 1)]
