"""Decode all pictures of a camera into one file of numpy's format, in parallel processes."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context, resource_tracker
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from manip_il.child_processes import bound_to_this_process, initialize_worker
from manip_il.data.frame_source import FrameSource, Part
from manip_il.errors import ManipError

_SMALL = 256 * 1024 * 1024  # bytes of pictures that are decoded about as soon as processes have started


def build_frames(
    source: FrameSource, path: Path, workers: int | None = None, on_frames: Callable[[int], None] | None = None
) -> None:
    """Write a camera's pictures to `path`, uint8 (N, 3, height, width).

    workers: processes; by default one a core, or none beside this one where there is little to decode. on_frames: told
    how many frames were added. Raises `OSError` where the disk has no room for all of them, before any is decoded, and
    what reading the dataset raises.
    """
    write = partial(_write, source, path, _reserve(source, path))
    workers = workers or (1 if source.nbytes < _SMALL else len(os.sched_getaffinity(0)))
    with contextlib.closing(_written(write, source.parts, workers)) as counts:
        for count in counts:
            if on_frames is not None:
                on_frames(count)


def _reserve(source: FrameSource, path: Path) -> int:
    """Create the file at its full size; return where the pictures start in it.

    Writing to a mapped file would end the process where the disk is full; so the room is taken now, and filled by
    plain writes.
    """
    header = {"descr": npy.dtype_to_descr(np.dtype(np.uint8)), "fortran_order": False, "shape": source.shape}
    with path.open("wb") as stream:
        npy.write_array_header_1_0(stream, header)
        stream.flush()
        os.posix_fallocate(stream.fileno(), 0, stream.tell() + source.nbytes)
        return stream.tell()


def _written(write: Callable[[Part], int], parts: Sequence[Part], workers: int) -> Generator[int]:
    """Frames of every part, once it is written."""
    if workers == 1:
        yield from map(write, parts)
        return
    pool = ProcessPoolExecutor(min(workers, len(parts)), get_context("spawn"), initializer=initialize_worker)
    try:
        with _interrupts_held(), bound_to_this_process():  # starts the processes
            futures = [pool.submit(write, part) for part in parts]
        for future in as_completed(futures):
            yield future.result()
    except BrokenExecutor as error:
        raise ManipError("a process that decodes pictures died (out of memory?)") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _write(source: FrameSource, path: Path, offset: int, part: Part) -> int:
    """Decode a part into its place; return how many frames it holds."""
    handle = os.open(path, os.O_WRONLY)
    frames = 0
    try:
        for row, pictures in source.read(part):
            content = memoryview(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).cast("B")
            place = offset + row * (source.nbytes // source.frames)
            while content:
                written = os.pwrite(handle, content, place)
                content, place = content[written:], place + written
            frames += len(pictures)
    finally:
        os.close(handle)
    return frames


@contextlib.contextmanager
def _interrupts_held() -> Generator[None]:
    """Processes started in here leave Ctrl-C to this one."""
    resource_tracker.ensure_running()  # here, as its own start would undo the mask
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
