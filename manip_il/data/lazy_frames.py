"""Pictures of a camera that are decoded when they are read, for those that do not fit in the frame cache."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from datasets.utils.logging import disable_progress_bar, enable_progress_bar, is_progress_bar_enabled
from numpy.typing import NDArray

import datasets
from manip_il.data import lerobot_layout as layout
from manip_il.data.frame_source import FrameSource, VideoPart, find_frames
from manip_il.data.parquet_files import UNREADABLE
from manip_il.data.pictures import Pictures, VideoReader, decode_cell
from manip_il.errors import ManipError

I64 = NDArray[np.int64]
_OPEN_FILES = 32  # videos that one process holds open
_CELL = {"bytes": datasets.Value("binary"), "path": datasets.Value("string")}  # as it is: its library decodes nothing


class LazyFrames:
    """The pictures as an array (N, 3, height, width) of which rows are read, in any order; none stays in memory.

    Raises what `find_frames` raises, and on reading `ManipError` for a picture that is not there, `MismatchError` for
    one of another size.
    """

    def __init__(self, root: Path, key: str):
        self._source = find_frames(root, key)
        self.shape = self._source.shape
        self._films = [part for part in self._source.parts if isinstance(part, VideoPart)]

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: I64) -> NDArray[np.uint8]:
        wanted, places = np.unique(rows, return_inverse=True)
        read = self._film if self._films else self._still
        pictures = [self._source.check_size(row, read(row))[0] for row in wanted.tolist()]
        return np.ascontiguousarray(np.stack(pictures).transpose(0, 3, 1, 2))[places.reshape(rows.shape)]

    def _film(self, row: int) -> Pictures:
        part = next(part for part in reversed(self._films) if part.row <= row)
        path = self._source.root / part.path
        return _reader(path, self._source.fingerprint).read(path, part.first + row - part.row, 1, self._source.fps)

    def _still(self, row: int) -> Pictures:
        stored, order = _stored(self._source)
        try:
            return decode_cell(stored[int(order[row])][self._source.key])[None]
        except UNREADABLE as error:
            place = f"in frame {row} of {self._source.root}"
            raise ManipError(f"cannot read the picture {self._source.key} {place}: {error}") from error


@lru_cache(_OPEN_FILES)
def _reader(path: Path, fingerprint: str) -> VideoReader:
    """One file's reader; a changed file has another fingerprint, and with that another one."""
    return VideoReader()


@lru_cache(_OPEN_FILES)
def _stored(source: FrameSource) -> tuple[Any, I64]:
    """The rows with their pictures as they are stored, mapped into memory, and the place of every frame among them."""
    columns = {source.key: _CELL, layout.INDEX: datasets.Value("int64")}
    paths: list[Any] = [str(path) for path in sorted(source.root.glob(layout.DATA_FILES))]
    try:
        with without_progress_bars():
            stored: Any = datasets.Dataset.from_parquet(
                paths, columns=list(columns), features=datasets.Features(columns)
            )
    except Exception as error:  # its own errors are of every kind
        raise ManipError(f"cannot read the pictures {source.key} of {source.root}: {error}") from error
    return stored, np.argsort(stored.data.column(layout.INDEX).to_numpy())


@contextlib.contextmanager
def without_progress_bars() -> Generator[None]:
    """Keep the Hugging Face library's progress bars off the terminal."""
    enabled = is_progress_bar_enabled()
    disable_progress_bar()
    try:
        yield
    finally:
        if enabled:
            enable_progress_bar()
