"""Cache the decoded pictures of datasets in files that are mapped into memory: reading one is copying it.

One folder a camera, named by the `fingerprint` of what its pictures depend on, so a changed dataset has another one. It
appears whole, in one rename, and is never changed; nothing removes it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from manip_il.child_processes import open_pool
from manip_il.data.atomic import WriteError, descriptor, new_folder
from manip_il.data.camera import Camera, Part
from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError, UsageError

FRAMES = "frames.npy"
_SMALL = 256 * 1024 * 1024  # bytes of pictures that are decoded about as soon as processes have started

Frames = NDArray[np.uint8]  # (N, 3, height, width)


def cache_folder() -> Path:
    """Return the folder of decoded pictures: `manip_il/frames` in the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "manip_il" / "frames"


def open_frame_cache(
    root: Path,
    image_keys: Sequence[str],
    *,
    max_bytes: int,
    folder: Path | None = None,
    workers: int | None = None,
    on_frames: Callable[[int], None] | None = None,
) -> dict[str, Frames] | None:
    """Return the decoded pictures of a dataset's cameras, read-only (N, 3, height, width); row i has `index` i.

    They are bit-equal to what LeRobot decodes (of 10-bit video by its backend pyav; torchcodec's differ). What `folder`
    lacks is decoded by `workers` processes (one a core by default; none beside this one where there is little to do).
    on_frames: called with the number of frames added.

    Returns None if the pictures take more than `max_bytes`: read them by `Camera` then. Raises what `Dataset.camera`
    raises, `UsageError` for a folder in the dataset, `ManipError` if the disk is full or cannot be written.
    """
    dataset = Dataset.open(root)
    cameras = [dataset.camera(key) for key in image_keys]
    if sum(camera.nbytes for camera in cameras) > max_bytes:
        return None
    folder = cache_folder() if folder is None else folder
    if folder.resolve().is_relative_to(root.resolve()):
        raise UsageError(f"{folder} is in the dataset {root}; set XDG_CACHE_HOME to a folder outside it")
    opened: dict[str, Frames] = {}
    try:
        for camera in cameras:
            path = folder / camera.fingerprint / FRAMES
            frames = _open(path, camera)
            if frames is None:
                _build(path.parent, camera, workers, on_frames)
                frames = np.load(path, mmap_mode="r")
            opened[camera.key] = frames
    except (OSError, WriteError) as error:
        refusal = error.__cause__ if isinstance(error, WriteError) else error
        raise ManipError(
            f"cannot keep decoded pictures in {folder}: {getattr(refusal, 'strerror', None) or refusal}; "
            "make room there, or set XDG_CACHE_HOME to another disk"
        ) from error
    return opened


def _open(path: Path, camera: Camera) -> Frames | None:
    """Map a file; None if it is not there, or not what it should be."""
    try:
        frames = np.load(path, mmap_mode="r")
    except (FileNotFoundError, ValueError):
        return None
    return frames if frames.shape == camera.shape and frames.dtype == np.uint8 else None


def _build(target: Path, camera: Camera, workers: int | None, on_frames: Callable[[int], None] | None) -> None:
    with new_folder(target, replace=True) as new:
        write = partial(_write_part, camera, new / FRAMES, _reserve(camera, new / FRAMES))
        with contextlib.closing(_written(write, camera, workers)) as counts:
            for count in counts:
                if on_frames is not None:
                    on_frames(count)


def _reserve(camera: Camera, path: Path) -> int:
    """Create the file at its full size; return where the pictures start in it.

    Writing to a mapped file would end the process where the disk is full; so the room is taken now, and filled by
    plain writes. Raises `OSError` where the disk has no room for all.
    """
    header = {"descr": npy.dtype_to_descr(np.dtype(np.uint8)), "fortran_order": False, "shape": camera.shape}
    with path.open("wb") as stream:
        npy.write_array_header_1_0(stream, header)
        stream.flush()
        os.posix_fallocate(stream.fileno(), 0, stream.tell() + camera.nbytes)
        return stream.tell()


def _written(write: Callable[[Part], int], camera: Camera, workers: int | None) -> Generator[int]:
    """Frames of every part, once it is written."""
    workers = workers or (1 if camera.nbytes < _SMALL else len(os.sched_getaffinity(0)))
    if workers == 1:
        yield from map(write, camera.parts)
        return
    pool = open_pool(min(workers, len(camera.parts)))
    try:
        futures = [pool.submit(write, part) for part in camera.parts]
        for future in as_completed(futures):
            yield future.result()
    except BrokenExecutor as error:
        raise ManipError("a process that decodes pictures died (out of memory?)") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _write_part(camera: Camera, path: Path, offset: int, part: Part) -> int:
    """Decode a part into its place; return how many frames it holds."""
    frames = 0
    with descriptor(path, os.O_WRONLY) as handle:
        for row, pictures in camera.read(part):
            content = memoryview(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).cast("B")
            place = offset + row * (camera.nbytes // camera.frames)
            while content:
                written = os.pwrite(handle, content, place)
                content, place = content[written:], place + written
            frames += len(pictures)
    return frames
