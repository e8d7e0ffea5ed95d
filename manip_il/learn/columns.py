"""From a dataset's columns to rows to learn from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
from numpy.typing import NDArray

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, NotFiniteError

EPISODE_INDEX = "episode_index"  # LeRobot's own columns
FRAME_INDEX = "frame_index"
INDEX = "index"
LEARNING_COLUMNS = (STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID, EPISODE_INDEX)

Table = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Rows:
    """Frames with a sound label. inputs: (N, n + k) raw; targets: (N, n) raw; episodes: (N,)."""

    inputs: NDArray[np.float32]
    targets: NDArray[np.float32]
    episodes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.inputs)


def check_table(table: Table, spec: RobotTaskSpec) -> None:
    """Raise unless `table` has the learning columns, with `spec`'s sizes, one length and finite values."""
    n, k = len(spec.joint_names), len(spec.environment_state_names)
    rows = None
    for key, width in ((STATE, n), (ENVIRONMENT_STATE, k), (ACTION, n)):
        if key not in table:
            raise ManipError(f"the table has no column {key!r}; it has {', '.join(sorted(table))}")
        column = np.asarray(table[key])
        if column.ndim != 2 or column.shape[1] != width:
            raise MismatchError("shape", f"column {key}", column.shape, f"robot {spec.robot}", f"(N, {width})")
        if rows is not None and len(column) != rows:
            raise MismatchError("length", f"column {key}", len(column), f"column {STATE}", rows)
        rows = len(column)
        _require_finite(table, key)


def learning_rows(table: Table) -> Rows:
    """Return the rows whose `label_valid` is not 0 (all of them where there is no such column).

    Targets are relative to the measured joints, the gripper's command is absolute. Without
    `episode_index` all rows count as one episode. Raises `ManipError` where no row is left.
    """
    state, action = np.asarray(table[STATE], np.float32), np.asarray(table[ACTION], np.float32)
    environment = np.asarray(table.get(ENVIRONMENT_STATE, np.empty((len(state), 0))), np.float32)
    episodes = np.asarray(table.get(EPISODE_INDEX, np.zeros(len(state))), np.int64).reshape(-1)
    valid = valid_frames(table)
    if not valid.any():
        raise ManipError(f"none of {len(valid)} frames has a valid label: there is nothing to learn from")
    targets = action.copy()
    targets[:, :-1] -= state[:, :-1]
    inputs = np.concatenate([state, environment], axis=1)
    return Rows(inputs[valid], targets[valid], episodes[valid])


def valid_frames(table: Table) -> NDArray[np.bool_]:
    """Return whether each frame takes part in the loss, (N,)."""
    if LABEL_VALID not in table:
        return np.ones(len(table[STATE]), dtype=bool)
    return np.asarray(table[LABEL_VALID]).reshape(-1) != 0


def split_by_episode(
    episodes: NDArray[np.int64], fraction: float, seed: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return row numbers to train on and to hold out: about `fraction` of the episodes, whole ones.

    Nothing is held out where that would be less than half an episode or all of them.
    """
    names = np.unique(episodes)
    count = round(fraction * len(names))
    if not 0 < count < len(names):
        return np.arange(len(episodes)), np.arange(0)
    held_out = np.random.default_rng([seed, 1]).permutation(names)[:count]
    mask = np.isin(episodes, held_out)
    return np.flatnonzero(~mask), np.flatnonzero(mask)


def read_columns(*roots: Path) -> dict[str, NDArray[Any]]:
    """Return the learning columns of LeRobot v3.0 datasets' parquet files, whole, in order of `index`, which goes on.

    Raises `ManipError` where the files are not there.
    """
    tables: list[dict[str, NDArray[Any]]] = []
    rows = 0
    for root in roots:
        table = _read_root(root)
        table[INDEX] = table[INDEX] + rows
        rows += len(table[INDEX])
        tables.append(table)
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def _read_root(root: Path) -> dict[str, NDArray[Any]]:
    folder = Path(root) / "data"
    if not folder.is_dir():
        raise ManipError(f"no folder {folder}: mlp and cnn read their statistics there; download the dataset first")
    source = pyarrow.dataset.dataset(folder, format="parquet")
    wanted = (STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID, INDEX)
    table = source.to_table(columns=[name for name in wanted if name in source.schema.names])
    order = np.argsort(table[INDEX].to_numpy(), kind="stable")
    return {name: _to_numpy(table[name])[order] for name in table.column_names}


def _to_numpy(column: Any) -> NDArray[Any]:
    rows = len(column)
    while pyarrow.types.is_nested(column.type):
        column = column.combine_chunks().flatten()
    values = column.to_numpy()
    return values.reshape(rows, -1) if len(values) != rows else values


def _require_finite(table: Table, key: str) -> None:
    finite = np.isfinite(table[key]).all(axis=1)
    if finite.all():
        return
    row = int(np.flatnonzero(~finite)[0])
    where = [f"row {row}"]
    for name, column in (("episode", EPISODE_INDEX), ("frame", FRAME_INDEX)):
        if column in table:
            where.append(f"{name} {int(np.asarray(table[column]).reshape(-1)[row])}")
    raise NotFiniteError(f"column {key}, {', '.join(where)}: {np.asarray(table[key])[row]} is not finite")
