"""Rows to learn from, out of a dataset's columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, NotFiniteError
from manip_il.learn.action_spaces import JOINT_DELTAS, Conversion

EPISODE_INDEX, FRAME_INDEX, INDEX = "episode_index", "frame_index", "index"  # LeRobot's own columns
LEARNING_COLUMNS = (STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID, EPISODE_INDEX)

I64 = NDArray[np.int64]
Table = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Rows:
    """Frames with a sound label. inputs: (N, n + k) raw; targets: (N, n) raw; episodes: (N,)."""

    inputs: NDArray[np.float32]
    targets: NDArray[np.float32]
    episodes: I64


def check_table(table: Table, spec: RobotTaskSpec) -> None:
    """Raise unless `table` has the learning columns, with `spec`'s sizes, one length and finite values."""
    n, k = len(spec.joint_names), len(spec.environment_state_names)
    for key, width in ((STATE, n), (ENVIRONMENT_STATE, k), (ACTION, n)):
        if key not in table:
            raise ManipError(f"the table has no column {key!r}; it has {', '.join(sorted(table))}")
        column, rows = np.asarray(table[key]), len(table[STATE])
        if column.ndim != 2 or column.shape[1] != width:
            raise MismatchError("shape", f"column {key}", column.shape, f"robot {spec.robot}", f"(N, {width})")
        if len(column) != rows:
            raise MismatchError("length", f"column {key}", len(column), f"column {STATE}", rows)
    require_finite(table, (STATE, ENVIRONMENT_STATE, ACTION))


def require_finite(table: Table, keys: Sequence[str]) -> None:
    """Raise `NotFiniteError` naming column, row, episode and frame unless all values of these columns are finite."""
    for key in keys:
        values = np.asarray(table[key])
        rows = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
        if len(rows) == 0:
            continue
        row = int(rows[0])
        place = [f"row {row}"]
        for name, column in (("episode", EPISODE_INDEX), ("frame", FRAME_INDEX)):
            if column in table:
                place.append(f"{name} {int(np.asarray(table[column]).reshape(-1)[row])}")
        raise NotFiniteError(f"column {key}, {', '.join(place)}: {values[row]} is not finite")


def learning_rows(table: Table, conversion: Conversion = JOINT_DELTAS) -> Rows:
    """Return the rows whose `label_valid` is not 0 (all of them where there is no such column).

    Targets are the actions in the space of `conversion`. Without `episode_index` all rows count as one episode. Raises
    `ManipError` where no row is left.
    """
    state, action = table[STATE], table[ACTION]
    environment = table.get(ENVIRONMENT_STATE, np.empty((len(state), 0), np.float32))
    episodes = np.asarray(table.get(EPISODE_INDEX, np.zeros(len(state))), np.int64).reshape(-1)
    valid = valid_frames(table)
    if not valid.any():
        raise ManipError(f"none of {len(valid)} frames has a valid label: there is nothing to learn from")
    inputs = np.concatenate([state[valid], environment[valid]], axis=1, dtype=np.float32)
    targets = conversion.encode(action[valid].astype(np.float32, copy=False), inputs[:, : state.shape[1]])
    return Rows(inputs, targets.astype(np.float32, copy=False), episodes[valid])


def valid_frames(table: Table) -> NDArray[np.bool_]:
    """Return whether each frame takes part in the loss, (N,)."""
    if LABEL_VALID not in table:
        return np.ones(len(table[STATE]), dtype=bool)
    return np.asarray(table[LABEL_VALID]).reshape(-1) != 0


def split_by_episode(episodes: I64, fraction: float, seed: int) -> tuple[I64, I64]:
    """Return the rows (of N) to train on and to hold out: about `fraction` of the episodes (N,), whole ones.

    Nothing is held out where that would be less than half an episode or all of them.
    """
    names = np.unique(episodes)
    count = round(fraction * len(names))
    if not 0 < count < len(names):
        return np.arange(len(episodes)), np.arange(0)
    held_out = np.random.default_rng([seed, 1]).permutation(names)[:count]
    mask = np.isin(episodes, held_out)
    return np.flatnonzero(~mask), np.flatnonzero(mask)
