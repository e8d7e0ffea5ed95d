"""Read the columns of a dataset that a reward needs, and find the datasets in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import EPISODE_INDEX, INFO
from manip_il.data.schema import RobotTaskSpec
from manip_il.learn.sources import check_same_sources
from manip_il.mdp import F32, F64, I64, require_finite

_ROUNDS = "round_*/dataset"  # a run's datasets


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of one or more datasets: states (N, n), environment states (N, k), actions (N, n).

    actions: as executed. episodes: episode number of each frame, (N,), ascending. progress, success: (N,), None
    if the dataset has no such column.
    """

    spec: RobotTaskSpec
    states: F32
    environment_states: F32
    actions: F32
    episodes: I64
    progress: F64 | None = None
    success: NDArray[np.bool_] | None = None

    @cached_property
    def firsts(self) -> I64:
        """Row of each episode's first frame, (E,)."""
        return np.flatnonzero(np.diff(self.episodes, prepend=-1))

    @cached_property
    def lengths(self) -> I64:
        """Number of frames of each episode, (E,)."""
        return np.diff(self.firsts, append=len(self.states))

    @cached_property
    def inputs(self) -> F32:
        """A reward's inputs, (N, n + k + n): state, environment state and action."""
        return np.concatenate([self.states, self.environment_states, self.actions], axis=1)


def read_frames(root: Path) -> Frames:
    """Return the frames of a dataset. Raises `ManipError` if it lacks our columns or has non-finite numbers."""
    dataset = Dataset.open(root)
    spec, present = dataset.spec, list(dataset.features)
    action = schema.EXECUTED_ACTION if schema.EXECUTED_ACTION in present else schema.ACTION
    needed = [schema.STATE, schema.ENVIRONMENT_STATE, action]
    more = [name for name in (schema.PROGRESS, schema.SUCCESS) if name in present]
    table = dataset.columns([*needed, *more, EPISODE_INDEX])
    for name in (*needed, *more):
        require_finite(f"{root}, column {name}", table[name])
    state, environment, executed = (np.ascontiguousarray(table[name], np.float32) for name in needed)
    progress, success = table.get(schema.PROGRESS), table.get(schema.SUCCESS)
    return Frames(
        spec,
        state,
        environment,
        executed,
        np.asarray(table[EPISODE_INDEX], np.int64).reshape(-1),
        None if progress is None else np.asarray(progress, np.float64).reshape(-1),
        None if success is None else np.asarray(success, bool).reshape(-1),
    )


def read_all(roots: Sequence[Path]) -> list[Frames]:
    """Return the frames of datasets. Raises `MismatchError` unless they have the same task and columns."""
    found = [read_frames(root) for root in roots]
    check_same_sources(roots, [one.spec for one in found], pictures=False, language=False)
    return found


def find_datasets(folders: Sequence[Path]) -> list[Path]:
    """Return the datasets in folders: for a run the datasets of all its rounds, otherwise the folder itself."""
    found: list[Path] = []
    for folder in folders:
        found += [path for path in sorted(folder.glob(_ROUNDS)) if (path / INFO).is_file()] or [folder]
    return found
