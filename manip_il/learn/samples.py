"""Samples of datasets: numbers in memory, pictures decoded before, or when they are drawn.

LeRobot's policies say by `*_delta_indices` which frames around a sample's own they want: its window. A frame outside of
the episode is the nearest one inside, and `<column>_is_pad` says so.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from numpy.typing import NDArray

from manip_il.data.camera import Camera
from manip_il.data.dataset import Dataset, joined_columns
from manip_il.data.lerobot_layout import STATS
from manip_il.data.schema import ACTION, LABEL_VALID
from manip_il.errors import ManipError, UsageError
from manip_il.learn.columns import EPISODE_INDEX, FRAME_INDEX, INDEX, require_finite, split_by_episode, valid_frames
from manip_il.learn.fit_config import FitConfig

_LOG = logging.getLogger(__name__)
I64 = NDArray[np.int64]
Batch = dict[str, Any]  # as LeRobot's DataLoader gives it: tensors, and `task` as a list of text
TASK, TASK_INDEX = "task", "task_index"
_ALWAYS = (EPISODE_INDEX, FRAME_INDEX, INDEX, TASK_INDEX, "timestamp")  # LeRobot's own columns
_MAX_HELD_OUT = 1_024  # samples that a validation looks at


@dataclass(frozen=True)
class Windows:
    """The frames that each sample is made of. episodes: the episode of every frame, (N,), in stored order.

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

    def padded_rows(self, samples: I64, key: str) -> tuple[I64, Batch]:
        """Return `rows` with the padding by LeRobot's name; without a window the samples (B,), and no padding."""
        if key not in self.deltas:
            return samples, {}
        rows, padded = self.rows(samples, key)
        return rows, {f"{key}_is_pad": torch.from_numpy(padded)}

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


def windows_of(policy: PreTrainedConfig, columns: Sequence[str], episodes: I64) -> Windows:
    """Return the windows that a policy learns from, of frames whose episodes are `episodes`, (N,).

    Raises `UsageError` for a dataset shorter than one chunk of actions.
    """
    actions, observations = policy.action_delta_indices, policy.observation_delta_indices
    wanted = {key: actions if key == ACTION else observations for key in columns}
    deltas = {key: np.asarray(indices, np.int64) for key, indices in wanted.items() if indices is not None}
    ahead = deltas.get(ACTION)
    if ahead is not None and len(episodes) < len(ahead):
        raise UsageError(
            f"the dataset has {len(episodes)} frames, fewer than one chunk of {len(ahead)} actions; record more, or "
            "ask for shorter chunks (--policy.chunk_size, for diffusion --policy.horizon)"
        )
    return Windows(episodes, deltas)


class JoinedFrames:
    """The pictures of several datasets as one array (N, 3, H, W) of which rows are read, without copying the rest."""

    def __init__(self, pieces: Sequence[NDArray[np.uint8] | Camera]):
        self._pieces = pieces
        self._ends = np.cumsum([len(piece) for piece in pieces])

    def __getitem__(self, rows: I64) -> NDArray[np.uint8]:
        if len(self._pieces) == 1:
            return self._pieces[0][rows]
        flat = rows.reshape(-1)
        read = np.empty((len(flat), *self._pieces[0].shape[1:]), np.uint8)
        which = np.searchsorted(self._ends, flat, side="right")
        for number in np.unique(which):
            start = self._ends[number - 1] if number else 0
            read[which == number] = self._pieces[number][flat[which == number] - start]
        return read.reshape(*rows.shape, *read.shape[1:])


@dataclass(frozen=True)
class SampleSource:
    """A batch is one gather a column.

    columns: numbers, (N, d) or (N,), by LeRobot's names. frames: camera column -> uint8 (N, 3, H, W). tasks: LeRobot's
    text of every `task_index`. workers: processes that read the pictures ahead; None reads them here, out of memory.
    """

    windows: Windows
    columns: Mapping[str, torch.Tensor]
    frames: Mapping[str, JoinedFrames]
    tasks: tuple[str, ...]
    workers: int | None = None

    def batches(self, samples: Iterable[I64]) -> Iterator[Batch]:
        """Return one batch for every array of sample numbers, (B,), in that order; pictures are uint8."""
        if self.workers is None or not self.frames:
            return (self.batch(one) for one in samples)
        loader = torch.utils.data.DataLoader(
            _Pictures(self.windows, self.frames),
            batch_size=None,
            sampler=samples,
            num_workers=self.workers,
            multiprocessing_context="spawn" if self.workers else None,  # decoders do not survive a fork
            generator=torch.Generator(),  # else it draws from the global one, and a resumed run would differ
        )
        return (self._numbers(one.numpy()) | pictures for one, pictures in loader)

    def batch(self, samples: I64) -> Batch:
        """Return the batch of these samples, (B,)."""
        return self._numbers(samples) | _Pictures(self.windows, self.frames)[samples][1]

    def _numbers(self, samples: I64) -> Batch:
        batch: Batch = {}
        for key, values in self.columns.items():
            rows, padded = self.windows.padded_rows(samples, key)
            batch[key] = values[torch.from_numpy(rows)]
            batch |= padded
        batch[TASK] = [self.tasks[int(i)] for i in batch[TASK_INDEX]]
        return batch


@dataclass(frozen=True)
class _Pictures(torch.utils.data.Dataset[tuple[I64, Batch]]):
    """The samples (B,) with their pictures, for `DataLoader`."""

    windows: Windows
    frames: Mapping[str, JoinedFrames]

    def __getitem__(self, samples: I64) -> tuple[I64, Batch]:
        batch: Batch = {}
        for key, values in self.frames.items():
            rows, padded = self.windows.padded_rows(samples, key)
            batch[key] = torch.from_numpy(values[rows])
            batch |= padded
        return samples, batch


@dataclass(frozen=True)
class Samples:
    """The data of one fit. train, held_out: sample numbers; digest: of everything that is learnt from."""

    source: SampleSource
    train: I64
    held_out: I64
    cameras: tuple[str, ...]
    digest: str


def load_samples(
    roots: Sequence[Path],
    policy: PreTrainedConfig,
    config: FitConfig,
    meta: Any,
    on_frames: Callable[[int], None] | None = None,
) -> Samples:
    """Return the samples of datasets, taken as one, for a policy that has its features.

    meta: LeRobot's metadata of the datasets, with the actions to learn where those are not the datasets'.
    on_frames: sees how many frames more have been decoded. Raises `NotFiniteError` and what `windows_of` and
    `Windows.usable` raise.
    """
    features = [*(policy.input_features or {}), ACTION]
    cameras = tuple(key for key in features if key in meta.camera_keys)
    numbers = [key for key in features if key not in cameras]
    label = [LABEL_VALID] if LABEL_VALID in meta.features else []
    table = joined_columns(roots, [*numbers, *_ALWAYS, *label])
    table[TASK_INDEX] = meta.joint_tasks(table[TASK_INDEX])
    if meta.learnt_actions is not None:
        table[ACTION] = meta.learnt_actions
    require_finite(table, numbers)
    episodes = table[EPISODE_INDEX].astype(np.int64).reshape(-1)
    windows = windows_of(policy, features, episodes)
    usable = windows.usable(valid_frames(table), getattr(policy, "drop_n_last_frames", 0))
    train, held_out = split_by_episode(episodes[usable], config.eval_split, config.seed)
    limit = int(config.image_cache_gb * 1e9)
    frames = _frames(roots, cameras, limit, on_frames)
    workers = None
    if frames is None:
        names, workers = ", ".join(map(str, roots)), config.num_workers
        _LOG.warning("the pictures of %s take more than %g GB: they are decoded on the fly", names, limit / 1e9)
        frames = read_later(roots, cameras)
    columns = {key: torch.from_numpy(table[key]) for key in (*numbers, *_ALWAYS)}
    source = SampleSource(windows, columns, frames, tuple(map(str, meta.tasks.index)), workers)
    if len(held_out) > _MAX_HELD_OUT:
        held_out = held_out[np.linspace(0, len(held_out) - 1, _MAX_HELD_OUT).astype(np.int64)]
    return Samples(source, usable[train], usable[held_out], cameras, _digest(roots, table))


def _frames(
    roots: Sequence[Path], cameras: Sequence[str], limit: int, on_frames: Callable[[int], None] | None
) -> dict[str, JoinedFrames] | None:
    """The decoded pictures of every camera in all datasets; None where they would take more than `limit` bytes."""
    opened = [Dataset.open(root) for root in roots]
    found = {key: [dataset.camera(key) for dataset in opened] for key in cameras}
    if sum(one.nbytes for each in found.values() for one in each) > limit:
        return None
    return {key: JoinedFrames([one.decode(on_frames) for one in each]) for key, each in found.items()}


def read_later(roots: Sequence[Path], cameras: Sequence[str]) -> dict[str, JoinedFrames]:
    """Return the pictures of every camera in all datasets, which are decoded when they are read."""
    return {camera: JoinedFrames([Dataset.open(root).camera(camera) for root in roots]) for camera in cameras}


def _digest(roots: Sequence[Path], table: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of the columns and of the datasets' statistics, which stand for the pictures."""
    digest = hashlib.sha256()
    for root in roots:
        path = root / STATS
        digest.update(path.read_bytes() if path.exists() else b"")
    for key, column in table.items():
        digest.update(key.encode())
        digest.update(np.ascontiguousarray(column))
    return digest.hexdigest()
