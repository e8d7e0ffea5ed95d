"""Make large arrays in memory, or in files that are mapped into it."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from manip_il.errors import ManipError

Allocate = Callable[[tuple[int, ...], DTypeLike], NDArray[Any]]
_ROWS = 65_536  # of a large array that are worked on at once


def in_memory(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return a new array (N, ...) whose content is not set."""
    return np.empty(shape, dtype)


def on_disk(folder: Path) -> Allocate:
    """Return what makes arrays of zeros in files of `folder` that have no name: each goes with its array, or a kill.

    Raises `ManipError` where the disk is full.
    """

    def allocate(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        size = math.prod(shape) * np.dtype(dtype).itemsize
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as file:
                os.posix_fallocate(file.fileno(), 0, max(1, size))  # a full disk is an error here, no crash later
                return np.memmap(file, dtype, "r+", shape=shape)
        except OSError as error:
            raise ManipError(
                f"cannot keep {size / 1e9:.1f} GB in {folder}: {error.strerror}; make room there, or give more --memory"
            ) from error

    return allocate


def pieces(rows: int) -> Iterator[slice]:
    """Yield slices that cover so many rows, in order."""
    return (slice(start, min(start + _ROWS, rows)) for start in range(0, rows, _ROWS))
