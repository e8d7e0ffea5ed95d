"""Where batches come from: columns in memory and frames in a memory-mapped cache, or LeRobot's own loader."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, override

import numpy as np
import torch
from numpy.typing import NDArray

from manip_il.learn.augment import to_float
from manip_il.learn.windows import Windows

I64 = NDArray[np.int64]
Batch = dict[str, Any]  # as LeRobot's DataLoader gives it: tensors, and `task` as a list of text
TASK, TASK_INDEX = "task", "task_index"


class Source(Protocol):
    """Batches for given samples."""

    def batches(self, samples: Iterable[I64]) -> Iterator[Batch]:
        """Return one batch for every array of sample numbers, (B,), in that order. Pictures are uint8 or float32."""
        ...


class JoinedFrames:
    """The pictures of several datasets as one array (N, 3, H, W) of which rows are read, without copying the rest."""

    def __init__(self, pieces: Sequence[NDArray[np.uint8]]):
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
class MemorySource:
    """A batch is one gather a column.

    columns: numbers, (N, d) or (N,), by LeRobot's names. frames: camera column -> uint8 (N, 3, H, W), memory-mapped.
    tasks: LeRobot's text of every `task_index`.
    """

    windows: Windows
    columns: Mapping[str, torch.Tensor]
    frames: Mapping[str, JoinedFrames]
    tasks: tuple[str, ...]

    def batches(self, samples: Iterable[I64]) -> Iterator[Batch]:
        """See `Source`."""
        return (self.batch(one) for one in samples)

    def batch(self, samples: I64) -> Batch:
        """Return the batch of these samples, (B,)."""
        batch: Batch = {}
        for key, column in self.columns.items():
            batch |= self._gather(key, samples, lambda rows, column=column: column[torch.from_numpy(rows)])
        for key, frames in self.frames.items():
            batch |= self._gather(key, samples, lambda rows, frames=frames: _read(frames, rows))
        batch[TASK] = [self.tasks[int(i)] for i in batch[TASK_INDEX]]
        return batch

    def _gather(self, key: str, samples: I64, read) -> Batch:
        if key not in self.windows.deltas:
            return {key: read(samples)}
        rows, padded = self.windows.rows(samples, key)
        return {key: read(rows), f"{key}_is_pad": torch.from_numpy(padded)}


@dataclass(frozen=True)
class LibrarySource:
    """LeRobot's dataset behind a `DataLoader`: slow, but it needs no memory.

    dataset: gives the windows already. workers: processes that decode.
    """

    dataset: torch.utils.data.Dataset[Batch]
    workers: int

    def batches(self, samples: Iterable[I64]) -> Iterator[Batch]:
        """See `Source`."""
        loader = torch.utils.data.DataLoader(
            self.dataset,
            batch_sampler=_Batches(samples),
            num_workers=self.workers,
            multiprocessing_context="spawn" if self.workers else None,  # decoders do not survive a fork
            generator=torch.Generator(),  # else it draws from the global one, and a resumed run would differ
        )
        return iter(loader)


class _Batches(torch.utils.data.Sampler[list[int]]):
    def __init__(self, samples: Iterable[I64]):
        self._samples = samples

    @override
    def __iter__(self) -> Iterator[list[int]]:
        return (one.tolist() for one in self._samples)


def pictures_to_float(batch: Batch, cameras: Iterable[str]) -> Batch:
    """Return the batch with its uint8 pictures as float32 in [0, 1]."""
    return batch | {key: to_float(batch[key]) for key in cameras if batch[key].dtype == torch.uint8}


def _read(frames: JoinedFrames, rows: I64) -> torch.Tensor:
    return torch.from_numpy(frames[rows])
