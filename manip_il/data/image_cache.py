"""Pictures of a dataset, decoded once into files that are mapped into memory: reading one is copying it.

One entry a camera: a folder named by the `fingerprint` of what its pictures depend on, so a changed dataset has
another entry. An entry's file is locked (shared) by every process that has it mapped, and has the time of its last
opening for its time of change; `.lock` is held by who adds or removes entries.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import shutil
from collections.abc import Callable, Generator, Sequence
from io import FileIO
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from manip_il.data.atomic import PARTIAL, new_folder
from manip_il.data.frame_build import build_frames
from manip_il.data.frame_source import FrameSource, find_frames
from manip_il.data.writing import WriteError
from manip_il.errors import ManipError, UsageError

FRAMES = "frames.npy"
ABOUT = "about.json"  # for who wonders what takes the room
_LOCK = ".lock"
_LOG = logging.getLogger(__name__)

Frames = NDArray[np.uint8]  # (N, 3, height, width)


def cache_folder() -> Path:
    """Return where decoded pictures are kept: `manip_il/frames` in the user's cache folder."""
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
    """Return the decoded pictures of a dataset's cameras, read-only (N, 3, height, width).

    Row i is the frame of `index` i.

    They are the ones that LeRobot decodes, bit by bit (of 10-bit video those of its backend pyav; torchcodec's differ).
    What `folder` lacks is decoded by `workers` processes (one a core by default), after what was not used for longest
    has made room; on_frames is told how many frames were added, N times the missing cameras in all. Another process
    that builds in `folder` is waited for.

    None where the pictures would take more than `max_bytes`, or would together with what other processes have open:
    read the dataset by `lerobot_windows` then. Raises what `find_frames` raises, `UsageError` for a folder in the
    dataset, `ManipError` where the disk is full or cannot be written.
    """
    sources = {key: find_frames(root, key) for key in image_keys}
    if sum(source.nbytes for source in sources.values()) > max_bytes:
        return None
    folder = cache_folder() if folder is None else folder
    if folder.resolve().is_relative_to(root.resolve()):
        raise UsageError(f"{folder} is in the dataset {root}; set XDG_CACHE_HOME to a folder outside it")
    try:
        opened = {key: _open(folder, source) for key, source in sources.items()}
        if any(frames is None for frames in opened.values()):
            with _alone(folder):  # by now another process may have built some
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


def _open(folder: Path, source: FrameSource) -> Frames | None:
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
        except ValueError:  # somebody else's file, or one cut short: built anew
            return None


def _build(
    folder: Path, source: FrameSource, workers: int | None, on_frames: Callable[[int], None] | None
) -> Frames | None:
    with new_folder(folder / source.fingerprint, replace=True) as partial:
        build_frames(source, partial / FRAMES, workers, on_frames)
        about = {"dataset": str(source.root.resolve()), "camera": source.key, "shape": source.shape}
        (partial / ABOUT).write_text(json.dumps(about, indent=4) + "\n", encoding="utf-8")
        if find_frames(source.root, source.key).fingerprint != source.fingerprint:
            raise ManipError(f"{source.root} changed while it was being read; try again when nothing writes to it")
    return _open(folder, source)


@contextlib.contextmanager
def _alone(folder: Path) -> Generator[None]:
    """Be the one who adds to the folder and removes from it; wait for whoever is."""
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _LOG.warning("another process decodes pictures into %s: waiting for it", folder)
            fcntl.flock(handle, fcntl.LOCK_EX)
        except OSError:
            pass  # a network file system may know no locks; then whoever is done last has its entry stay
        yield
    finally:
        os.close(handle)


def _make_room(folder: Path, needed: int, max_bytes: int) -> bool:
    """Remove the entries that were not opened for longest until `needed` bytes fit; none where that cannot be."""
    for partial in folder.glob(f".*{PARTIAL}"):  # what a killed process left
        with _unused(partial) as unused:
            if unused:
                shutil.rmtree(partial, ignore_errors=True)
    paths = sorted(folder.glob(f"[!.]*/{FRAMES}"), key=lambda path: path.stat().st_mtime_ns)
    sizes = {path: path.stat().st_size for path in paths}
    total = sum(sizes.values()) + needed
    if total - sum(size for path, size in sizes.items() if _is_free(path)) > max_bytes:
        return False
    for path, size in sizes.items():
        if total <= max_bytes:
            break
        total -= size if _remove(path) else 0
    return total <= max_bytes


def _is_free(path: Path) -> bool:
    with _unused(path) as unused:
        return unused


def _remove(path: Path) -> bool:
    """Remove the entry of this file unless it is in use; under another name, so that no half of it is seen."""
    with _unused(path) as unused:
        if unused:
            gone = path.parent.with_name(f".{path.parent.name}.removed{PARTIAL}")
            path.parent.rename(gone)
            shutil.rmtree(gone, ignore_errors=True)
    return unused


@contextlib.contextmanager
def _unused(path: Path) -> Generator[bool]:
    """Hold a file or folder that nobody has locked; False where somebody has, or where locks are not known."""
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        yield False
    else:
        yield True
    finally:
        os.close(handle)
