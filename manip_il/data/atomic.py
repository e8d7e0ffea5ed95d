"""Write files and folders atomically, and name the path if a disk is full or read-only."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import json
import os
import shutil
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

from manip_il.errors import FolderExistsError, ManipError

PARTIAL = ".partial"  # suffix of unfinished files and folders
_WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # never raised by reading


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Raise `ManipError` if the disk is full or read-only. It names the file that failed, or `path` if unknown."""
    try:
        yield
    except OSError as error:  # errors of Arrow and FFmpeg are OSErrors, too
        if error.errno not in _WRITE_ERRORS:
            raise
        raise ManipError(f"cannot write {error.filename or path}: {os.strerror(error.errno)}") from error


@contextlib.contextmanager
def new_folder(root: Path, *, replace: bool = False) -> Generator[Path]:
    """Yield an empty sibling of `root` to write into; at the end, sync it to disk and rename it to `root`.

    An exception removes the sibling; the next writer removes one left by a killed process. Raises `FolderExistsError`
    if `root` is not empty (checked at the beginning and end), unless `replace`: then the new folder takes its place.
    Raises `ManipError` if the disk is full or read-only, or if another process writes the same folder.
    """
    root = root.absolute()
    if not (replace and root.is_dir()):
        _require_empty(root)
    partial = root.with_name(f".{root.name}{PARTIAL}")
    if partial.is_symlink():  # a planted link: its target must not be cleared
        partial.unlink()
    with writing(root), exclusive(partial) as handle:
        clear(partial)
        try:
            yield partial
            _libc("syncfs", handle)  # one call for all files
            if replace and root.exists():
                here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE: `root` exists at every moment
                _libc("renameat2", here, os.fsencode(partial), here, os.fsencode(root), exchange)
            else:
                _require_empty(root)
                partial.rename(root)
            sync(root.parent)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def exclusive(folder: Path) -> Generator[int]:
    """Lock `folder` for this process, creating it if it does not exist; yield its file descriptor.

    The kernel releases the locks of a killed process. Raises `ManipError` if another process holds the lock.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        if not _try_lock(handle):
            raise ManipError(
                f"{folder} is in use by another process; wait until that is done, or choose another folder"
            )
        try:
            yield handle
        finally:
            with contextlib.suppress(OSError):
                folder.rmdir()  # if nothing was written
    finally:
        os.close(handle)


def clear(folder: Path) -> None:
    """Delete everything in a folder, but not the folder itself, which may be locked or a mount point."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write `content` to `path` as JSON, atomically as `write_file` does."""
    write_file(path, (json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode())


def write_file(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically, creating its folder.

    Raises `ManipError` if the disk is full or read-only.
    """
    partial = path.with_name(f".{path.name}.{os.urandom(6).hex()}{PARTIAL}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with partial.open("xb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        sync(path.parent)  # otherwise a power cut may undo the rename


def sync(path: Path) -> None:
    """Flush a file's content, or a folder's list of names, to disk."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _try_lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed; return False if another process holds it."""
    with contextlib.suppress(OSError):  # a cluster's file system may not support locks
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _libc(name: str, *arguments: int | bytes) -> None:
    """Call a function of Linux's C library that Python does not wrap."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _require_empty(root: Path) -> None:
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise FolderExistsError(root)
