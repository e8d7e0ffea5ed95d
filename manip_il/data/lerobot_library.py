"""LeRobot's metadata of datasets, which its policies ask for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, override

import numpy as np
import pandas as pd
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.io_utils import load_info
from lerobot.utils.constants import IMAGENET_STATS
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import TASK_INDEX, TASKS
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE
from manip_il.data.statistics import column_statistics
from manip_il.errors import ManipError, MismatchError

I64 = NDArray[np.int64]
LEARNT = (STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID)  # columns that datasets taken as one must share


class Metadata(LeRobotDatasetMetadata):
    """LeRobot's metadata of one dataset, or of several as one.

    roots, frames, episodes: folder and counts of each. task_numbers: of each, the joint number of its every task.
    learnt_actions: what is learnt in place of the column `action`, (N, n), where that is converted first.
    """

    roots: tuple[Path, ...] = ()
    frames: tuple[int, ...] = ()
    episodes_of: tuple[int, ...] = ()
    task_numbers: tuple[I64, ...] = ()
    learnt_actions: NDArray[np.float32] | None = None

    @override
    def _load_metadata(self) -> None:
        """Read the files with this program's readers: LeRobot's decode what the files' own metadata asks for."""
        dataset = Dataset.open(self.root)
        self.info = load_info(self.root)
        texts = dataset.tasks
        if sorted(texts) != list(range(len(texts))):
            found = checks.shorten(sorted(texts))
            raise ManipError(
                f"{self.root / TASKS}: task_index holds {found}; expected 0 to {len(texts) - 1}, each once"
            )
        self.tasks = _tasks([texts[number] for number in range(len(texts))])
        self.episodes = None  # nobody asks for them
        self.stats = dataset.statistics
        self.info.features = {
            key: value
            for key, value in self.info.features.items()
            if key not in dataset.cameras or dataset.features[key].is_rgb
        }

    def joint_tasks(self, own: I64) -> I64:
        """Return the joint number of the task of every frame of all datasets, (N,), from each dataset's own, (N,).

        Raises `ManipError` for a number without a text.
        """
        pieces = np.split(own, np.cumsum(self.frames)[:-1])
        for root, numbers, piece in zip(self.roots, self.task_numbers, pieces, strict=True):
            if len(unknown := piece[(piece < 0) | (piece >= len(numbers))]):
                raise ManipError(f"{root}: rows have the task {unknown[0]}, which {TASKS} does not hold")
        return np.concatenate([numbers[piece] for numbers, piece in zip(self.task_numbers, pieces, strict=True)])


def learn_actions(meta: Metadata, actions: NDArray[np.float32]) -> None:
    """Set what is learnt in place of the column `action`, (N, n), with statistics of its own."""
    meta.learnt_actions = actions
    meta.stats = {**(meta.stats or {}), **column_statistics({ACTION: actions})}


def read_metadata(*roots: Path) -> Metadata:
    """Return LeRobot's own description of a dataset, or of several as one, from which its factories build policies.

    The cameras' statistics are ImageNet's, as `lerobot-train` takes them by default. Raises `ManipError` for a folder
    that is no dataset, `MismatchError` for several of different rates or columns to learn from. Columns that not all
    have in one shape, cameras too, are left out; statistics are those of all frames, each counted once.
    """
    metas = [Metadata(f"local/{root.name}", root=root) for root in roots]
    first = metas[0]
    for meta in metas[1:]:
        _check_same_nature(first, meta)
    first.roots = roots
    first.frames = tuple(meta.total_frames for meta in metas)
    first.episodes_of = tuple(meta.total_episodes for meta in metas)
    _join_tasks(first, metas)
    if len(metas) > 1:
        alike = {key for key in first.features if all(_shape(meta, key) == _shape(first, key) for meta in metas)}
        first.info.features = {key: value for key, value in first.features.items() if key in alike}
    stats: list[dict[str, Any]] = [meta.stats or {} for meta in metas]
    shared = [{key: one for key, one in own.items() if key in first.features} for own in stats]
    joined = stats[0] if len(metas) == 1 else aggregate_stats(shared)
    for key in first.camera_keys:
        joined[key] = joined.get(key, {}) | {
            name: np.asarray(values, np.float32) for name, values in IMAGENET_STATS.items()
        }
    first.stats = joined
    first.info.total_episodes = sum(first.episodes_of)
    first.info.total_frames = sum(first.frames)
    return first


def _check_same_nature(left: Metadata, right: Metadata) -> None:
    """Raise `MismatchError` unless rate and the columns that are learnt from agree."""
    sides = str(left.root), str(right.root)
    if left.fps != right.fps:
        raise MismatchError("rate", sides[0], left.fps, sides[1], right.fps)
    for key in LEARNT:
        ours, theirs = _shape(left, key), _shape(right, key)
        if ours != theirs:
            raise MismatchError(f"column {key}", sides[0], ours or "none", sides[1], theirs or "none")


def _shape(meta: Metadata, key: str) -> tuple[int, ...]:
    """A column's shape; () where there is none."""
    return tuple(meta.features.get(key, {}).get("shape", ()))


def _join_tasks(first: Metadata, metas: Sequence[Metadata]) -> None:
    """Give `first` the instructions of all, each once, and the numbers that each dataset's have there."""
    own = [_instructions(meta) for meta in metas]
    joint = {text: number for number, text in enumerate(dict.fromkeys(text for texts in own for text in texts))}
    first.task_numbers = tuple(np.array([joint[text] for text in texts], np.int64) for texts in own)
    first.tasks = _tasks(list(joint))


def _tasks(texts: Sequence[str]) -> pd.DataFrame:
    """Tasks as LeRobot has them, numbered in this order."""
    return pd.DataFrame({TASK_INDEX: range(len(texts))}, index=pd.Index(texts, name="task"))


def _instructions(meta: Metadata) -> list[str]:
    return list(map(str, meta.tasks.index))
