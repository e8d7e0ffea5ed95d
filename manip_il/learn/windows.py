"""Samples of a dataset for policies that look back and plan ahead: windows of columns that lie in memory.

LeRobot's policies say by `*_delta_indices` which frames around a sample's own they want; a frame outside of the
episode is the nearest one inside, and `<column>_is_pad` says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from lerobot.configs import PreTrainedConfig
from numpy.typing import NDArray

from manip_il.data.schema import ACTION, REWARD
from manip_il.errors import ManipError, UsageError

I64 = NDArray[np.int64]
OBSERVATION = "observation."


@dataclass(frozen=True)
class Windows:
    """Which frames each sample is made of. episodes: the episode of every frame, (N,), in stored order.

    deltas: column -> frames relative to the sample's own, (K,); a column that is not there is taken as it is.
    """

    episodes: I64
    deltas: Mapping[str, I64]
    _first: I64 = field(init=False, repr=False)  # row of the first frame of every frame's episode
    _last: I64 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        starts = np.flatnonzero(np.diff(self.episodes, prepend=self.episodes[0] - 1))
        ends = np.append(starts[1:], len(self.episodes))
        object.__setattr__(self, "_first", np.repeat(starts, ends - starts))
        object.__setattr__(self, "_last", np.repeat(ends - 1, ends - starts))

    def rows(self, samples: I64, key: str) -> tuple[I64, NDArray[np.bool_]]:
        """Return row numbers (B, K) of one column's frames, and which are padding beyond the episode (B, K)."""
        wanted = samples[:, None] + self.deltas[key]
        inside = np.clip(wanted, self._first[samples, None], self._last[samples, None])
        return inside, inside != wanted

    def usable(self, valid: NDArray[np.bool_], drop_last: int = 0) -> I64:
        """Return the samples to learn from (S,): every label in the window is sound, `drop_last` frames left out.

        valid: whether each frame's label is sound, (N,). drop_last: LeRobot's `drop_n_last_frames`. Raises
        `ManipError` where nothing is left.
        """
        samples = np.flatnonzero(np.arange(len(valid)) + drop_last <= self._last)
        if ACTION in self.deltas:
            rows, _ = self.rows(samples, ACTION)
            samples = samples[valid[rows].all(axis=1)]
        else:
            samples = samples[valid[samples]]
        if len(samples) == 0:
            raise ManipError(f"none of {len(valid)} frames has valid labels in its whole window: nothing to learn from")
        return samples


def windows_of(config: PreTrainedConfig, columns: Sequence[str], episodes: I64) -> Windows:
    """Return the windows that a policy asks for.

    Raises `UsageError` for a dataset shorter than one chunk of actions.
    """
    deltas = {}
    for key in columns:
        indices = _delta_indices(config, key)
        if indices is not None:
            deltas[key] = np.asarray(indices, np.int64)
    ahead = deltas.get(ACTION)
    if ahead is not None and len(episodes) < len(ahead):
        raise UsageError(
            f"the dataset has {len(episodes)} frames, fewer than one chunk of {len(ahead)} actions; record more, or "
            "ask for shorter chunks (--policy.chunk_size, for diffusion --policy.horizon)"
        )
    return Windows(episodes, deltas)


def _delta_indices(config: PreTrainedConfig, key: str) -> Sequence[int] | None:
    if key == ACTION:
        return config.action_delta_indices
    if key == REWARD:
        return config.reward_delta_indices
    return config.observation_delta_indices if key.startswith(OBSERVATION) else None
