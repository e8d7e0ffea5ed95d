"""Read the columns of a dataset that a reward takes, and find the datasets that a folder stands for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema
from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.lerobot_layout import EPISODE_INDEX, INFO
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.samples import require_finite

F32, F64, I64 = NDArray[np.float32], NDArray[np.float64], NDArray[np.int64]
_ROUNDS = "round_*/dataset"  # of a run
_AGREE = ("robot", "task", "fps", "joint_names", "object", "environment_state_names", "action_meaning")


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a dataset, or of several joined: states (N, n), environment states (N, k), actions (N, n).

    actions: what drove the robot. episodes: number of each frame's, (N,), ascending. progress, success: (N,), None
    where the dataset has no such column.
    """

    spec: RobotTaskSpec
    states: F32
    environment_states: F32
    actions: F32
    episodes: I64
    progress: F64 | None = None
    success: NDArray[np.bool_] | None = None
    firsts: I64 = field(init=False, repr=False)  # row of every episode's first frame, (E,)
    lengths: I64 = field(init=False, repr=False)  # frames of every episode, (E,)

    def __post_init__(self) -> None:
        count = len(self.states)
        for name in ("environment_states", "actions", "episodes", "progress", "success"):
            column = getattr(self, name)
            if column is not None and len(column) != count:
                raise MismatchError("frames", "the states", count, name.replace("_", " "), len(column))
        firsts = np.flatnonzero(np.diff(self.episodes, prepend=-1))
        object.__setattr__(self, "firsts", firsts)
        object.__setattr__(self, "lengths", np.diff(firsts, append=count))

    @cached_property
    def inputs(self) -> F32:
        """Inputs of a reward, (N, n + k + n): state, environment state and action."""
        return np.concatenate([self.states, self.environment_states, self.actions], axis=1)

    def rows(self, episode: int) -> slice:
        """Return the rows of an episode, by its place (0 to E - 1)."""
        return slice(int(self.firsts[episode]), int(self.firsts[episode] + self.lengths[episode]))


def read_frames(root: Path) -> Frames:
    """Return the frames of a dataset. Raises `ManipError` for one that lacks our columns, or is not finite."""
    dataset = Dataset.open(root)
    spec, there = dataset.spec, list(dataset.features)
    action = schema.EXECUTED_ACTION if schema.EXECUTED_ACTION in there else schema.ACTION
    needed = [schema.STATE, schema.ENVIRONMENT_STATE, action]
    if missing := [name for name in needed if name not in there]:
        raise ManipError(f"{root} lacks {', '.join(missing)}, of which a reward is a function")
    more = [name for name in (schema.PROGRESS, schema.SUCCESS) if name in there]
    table = dataset.columns([*needed, *more, EPISODE_INDEX])
    require_finite(table, [*needed, *(name for name in more if name == schema.PROGRESS)])
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


def find_datasets(folders: Sequence[Path]) -> list[Path]:
    """Return the datasets that folders stand for: themselves, or every round's of a run.

    Raises `UsageError` for a folder that is neither.
    """
    found: list[Path] = []
    for folder in folders:
        rounds = [path for path in sorted(folder.glob(_ROUNDS)) if (path / INFO).is_file()]
        if not (folder / INFO).is_file() and not rounds:
            raise UsageError(
                f"{folder} {'is' if folder.exists() else 'does not exist; expected'} "
                f"{'neither a LeRobot dataset nor' if folder.exists() else 'a LeRobot dataset or'} a run with rounds"
            )
        found += [folder] if (folder / INFO).is_file() else rounds
    if twice := next((path for path in found if found.count(path) > 1), None):
        raise UsageError(f"{twice} is given twice; expected each source once")
    return found


def check_same(left_name: str, left: RobotTaskSpec, right_name: str, right: RobotTaskSpec) -> None:
    """Raise `MismatchError` unless two datasets are of one task, and their columns mean the same."""
    for name in _AGREE:
        one, other = getattr(left, name), getattr(right, name)
        if one != other and not (name == "task" and UNKNOWN_TASK in (one, other)):
            raise MismatchError(name.replace("_", " "), left_name, one, right_name, other)
