"""Write files and folders atomically, and name the path if a disk is full or read-only."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import shutil
from collections.abc import Generator
from pathlib import Path

from manip_il import checks
from manip_il.errors import FolderExistsError, ManipError

PARTIAL = ".partial"  # suffix of unfinished files and folders
_WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # never raised by reading


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Raise `ManipError` naming the file, or else `path`, if the disk is full or read-only."""
    try:
        yield
    except OSError as error:  # errors of Arrow and FFmpeg are OSErrors, too
        if error.errno not in _WRITE_ERRORS:
            raise
        raise ManipError(f"cannot write {error.filename or path}: {os.strerror(error.errno)}") from error


@contextlib.contextmanager
def new_folder(root: Path, *, replace: bool = False) -> Generator[Path]:
    """Yield an empty sibling of `root` to write into; at the end, sync it to disk and rename it to `root`.

    An exception removes the sibling; the next writer removes the leftovers of a killed one. Raises `FolderExistsError`
    if `root` is not empty, at the beginning or end; with `replace` the old folder is removed once the new one is
    complete. Raises `ManipError` if the disk is full or read-only.
    """
    root = root.absolute()
    if not (replace and root.is_dir()):
        _require_empty(root)
    with writing(root):
        root.parent.mkdir(parents=True, exist_ok=True)
        for left in root.parent.glob(f".{root.name}.*{PARTIAL}"):
            lock = os.open(left, os.O_RDONLY)
            if _try_lock(lock):  # fails while its writer lives
                shutil.rmtree(left, ignore_errors=True)
            os.close(lock)
        partial = _partial(root)
        partial.mkdir()
    lock = os.open(partial, os.O_RDONLY)
    _try_lock(lock)  # the kernel releases it when the writer dies, which identifies leftovers
    try:
        with writing(root):
            yield partial
            _libc("syncfs", lock)  # one call for all files
        if replace and root.exists():
            here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE: `root` exists at every moment
            _libc("renameat2", here, os.fsencode(partial), here, os.fsencode(root), exchange)
            shutil.rmtree(partial, ignore_errors=True)
        else:
            _require_empty(root)
            partial.rename(root)
        sync(root.parent)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    finally:
        os.close(lock)


@contextlib.contextmanager
def exclusive(folder: Path) -> Generator[None]:
    """Lock `folder`, which need not exist, for this process by a file `.<name>.lock` next to it.

    If the file cannot be written (next to a container's volume), the folder is not locked. Raises `ManipError`, with
    the owner's process id, if another process holds the lock. The kernel releases locks of a killed process.
    """
    path = folder.absolute().with_name(f".{folder.absolute().name}.lock")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = _lock(folder, path)
    try:
        yield
    finally:
        if handle is not None:
            path.unlink(missing_ok=True)  # before unlocking, so that no other process's file is removed
            os.close(handle)


def _lock(folder: Path, path: Path) -> int | None:
    """Return the lock file, open and locked; None if it cannot be written."""
    try:
        handle = checks.without_link(str(path), os.O_RDWR | os.O_CREAT)
    except OSError as error:
        if folder.is_dir() and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            return None
        raise
    if not _try_lock(handle):
        holder = os.pread(handle, 32, 0).decode(errors="replace").strip()
        os.close(handle)
        busy = f"{folder} is in use by process {holder or 'unknown'}"
        raise ManipError(f"{busy}; wait until that is done, or choose another folder")
    os.ftruncate(handle, 0)
    os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
    return handle


def write_file(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically, and make its folder.

    Raises `ManipError` if the disk is full or read-only.
    """
    partial = _partial(path)
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
        sync(path.parent)  # else a power cut may undo the rename


def sync(path: Path) -> None:
    """Flush a file's content, or a folder's list of names, to disk."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _partial(path: Path) -> Path:
    """Return a unique sibling."""
    return path.with_name(f".{path.name}.{os.urandom(6).hex()}{PARTIAL}")


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
