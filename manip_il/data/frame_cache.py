"""Cache the decoded pictures of datasets in files that are mapped into memory: reading one is copying it.

One entry a camera: a folder named by the `fingerprint` of what its pictures depend on, so a changed dataset has
another entry. Every process that has an entry's file mapped holds a shared lock on it; the file's time of change is
its last opening. `.lock` is held while entries are added or removed.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import shutil
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from functools import partial
from io import FileIO
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from manip_il.child_processes import open_pool
from manip_il.data.atomic import PARTIAL, WriteError, descriptor, new_folder, try_lock
from manip_il.data.camera import Camera, Part
from manip_il.data.dataset import Dataset
from manip_il.errors import ManipError, UsageError

FRAMES = "frames.npy"
ABOUT = "about.json"  # says which dataset and camera an entry is of
_LOCK = ".lock"
_SMALL = 256 * 1024 * 1024  # bytes of pictures that are decoded about as soon as processes have started
_LOG = logging.getLogger(__name__)

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
    lacks is decoded by `workers` processes (one a core by default; none beside this one where there is little to do);
    entries not used for longest are removed to make room. on_frames: called with the number of frames added. Waits for
    another process that builds in `folder`.

    Returns None where the pictures would take more than `max_bytes`, alone or with what other processes have open: read
    them by `Camera` then. Raises what `Dataset.camera` raises, `UsageError` for a folder in the dataset,
    `ManipError` where the disk is full or cannot be written.
    """
    dataset = Dataset.open(root)
    sources = {key: dataset.camera(key) for key in image_keys}
    if sum(source.nbytes for source in sources.values()) > max_bytes:
        return None
    folder = cache_folder() if folder is None else folder
    if folder.resolve().is_relative_to(root.resolve()):
        raise UsageError(f"{folder} is in the dataset {root}; set XDG_CACHE_HOME to a folder outside it")
    try:
        opened = {key: _open(folder, source) for key, source in sources.items()}
        if any(frames is None for frames in opened.values()):
            with _exclusive(folder):  # by now another process may have built some
                opened = {key: _open(folder, source) for key, source in sources.items()}
                missing = [source for key, source in sources.items() if opened[key] is None]
                if not _make_room(folder, sum(source.nbytes for source in missing), max_bytes):
                    return None
                for source in missing:
                    opened[source.key] = _build(folder, source, workers, on_frames)
    except (OSError, WriteError) as error:
        refusal = error.__cause__ if isinstance(error, WriteError) else error
        raise ManipError(
            f"cannot keep decoded pictures in {folder}: {getattr(refusal, 'strerror', None) or refusal}; "
            "make room there, or set XDG_CACHE_HOME to another disk"
        ) from error
    return {key: frames for key, frames in opened.items() if frames is not None}


def _open(folder: Path, source: Camera) -> Frames | None:
    """Map an entry, and count that as its use; None where it is not there."""
    path = folder / source.fingerprint / FRAMES
    try:
        file = FileIO(path)
    except FileNotFoundError:
        return None
    with file:
        with contextlib.suppress(OSError):  # a network file system may know no locks, a shared cache be read-only
            fcntl.flock(file, fcntl.LOCK_SH)
        if not path.exists() or not os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return None  # it was removed meanwhile
        with contextlib.suppress(OSError):
            os.utime(path)
        try:
            npy.read_magic(file)
            npy.read_array_header_1_0(file)
            # the mapping keeps the file open, and by that its lock, for as long as any array of it lives
            return np.memmap(file, np.uint8, "r", file.tell(), source.shape)
        except ValueError:  # another program's file, or one cut short: built anew
            return None


def _build(folder: Path, source: Camera, workers: int | None, on_frames: Callable[[int], None] | None) -> Frames | None:
    with new_folder(folder / source.fingerprint, replace=True) as new:
        write = partial(_write_part, source, new / FRAMES, _reserve(source, new / FRAMES))
        with contextlib.closing(_written(write, source, workers)) as counts:
            for count in counts:
                if on_frames is not None:
                    on_frames(count)
        about = {"dataset": str(source.root.resolve()), "camera": source.key, "shape": source.shape}
        (new / ABOUT).write_text(json.dumps(about, indent=4) + "\n", encoding="utf-8")
        if Dataset.open(source.root).camera(source.key).fingerprint != source.fingerprint:
            raise ManipError(f"{source.root} changed while it was being read; try again when nothing writes to it")
    return _open(folder, source)


@contextlib.contextmanager
def _exclusive(folder: Path) -> Generator[None]:
    """Hold the right to add and remove entries; wait for a process that holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    with descriptor(folder / _LOCK, os.O_RDWR | os.O_CREAT) as handle:
        if not try_lock(handle):  # without locks the entry that is finished last stays
            _LOG.warning("another process decodes pictures into %s: waiting for it", folder)
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def _make_room(folder: Path, needed: int, max_bytes: int) -> bool:
    """Remove the entries not opened for longest until `needed` bytes fit; none where they cannot be made to fit."""
    for leftover in folder.glob(f".*{PARTIAL}"):  # of a killed process
        with _unused(leftover) as unused:
            if unused:
                shutil.rmtree(leftover, ignore_errors=True)
    paths = sorted(folder.glob(f"[!.]*/{FRAMES}"), key=lambda path: path.stat().st_mtime_ns)
    sizes = {path: path.stat().st_size for path in paths}
    total = sum(sizes.values()) + needed
    if total - sum(size for path, size in sizes.items() if _is_unused(path)) > max_bytes:
        return False
    for path, size in sizes.items():
        if total <= max_bytes:
            break
        total -= size if _remove(path) else 0
    return total <= max_bytes


def _is_unused(path: Path) -> bool:
    with _unused(path) as unused:
        return unused


def _remove(path: Path) -> bool:
    """Remove the entry of this file unless it is in use; renamed first, so that nobody opens half of it."""
    with _unused(path) as unused:
        if unused:
            gone = path.parent.with_name(f".{path.parent.name}.removed{PARTIAL}")
            path.parent.rename(gone)
            shutil.rmtree(gone, ignore_errors=True)
    return unused


@contextlib.contextmanager
def _unused(path: Path) -> Generator[bool]:
    """Lock a file or folder; gives False where another process has it locked, or where there are no locks."""
    with descriptor(path) as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield True


def _reserve(source: Camera, path: Path) -> int:
    """Create the file at its full size; return where the pictures start in it.

    Writing to a mapped file would end the process where the disk is full; so the room is taken now, and filled by
    plain writes. Raises `OSError` where the disk has no room for all.
    """
    header = {"descr": npy.dtype_to_descr(np.dtype(np.uint8)), "fortran_order": False, "shape": source.shape}
    with path.open("wb") as stream:
        npy.write_array_header_1_0(stream, header)
        stream.flush()
        os.posix_fallocate(stream.fileno(), 0, stream.tell() + source.nbytes)
        return stream.tell()


def _written(write: Callable[[Part], int], source: Camera, workers: int | None) -> Generator[int]:
    """Frames of every part, once it is written."""
    workers = workers or (1 if source.nbytes < _SMALL else len(os.sched_getaffinity(0)))
    if workers == 1:
        yield from map(write, source.parts)
        return
    pool = open_pool(min(workers, len(source.parts)))
    try:
        futures = [pool.submit(write, part) for part in source.parts]
        for future in as_completed(futures):
            yield future.result()
    except BrokenExecutor as error:
        raise ManipError("a process that decodes pictures died (out of memory?)") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _write_part(source: Camera, path: Path, offset: int, part: Part) -> int:
    """Decode a part into its place; return how many frames it holds."""
    frames = 0
    with descriptor(path, os.O_WRONLY) as handle:
        for row, pictures in source.read(part):
            content = memoryview(np.ascontiguousarray(pictures.transpose(0, 3, 1, 2))).cast("B")
            place = offset + row * (source.nbytes // source.frames)
            while content:
                written = os.pwrite(handle, content, place)
                content, place = content[written:], place + written
            frames += len(pictures)
    return frames
