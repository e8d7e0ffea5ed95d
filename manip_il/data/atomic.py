"""Write files and folders so that they are there whole or not at all, and name the path where a disk refuses."""

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

PARTIAL = ".partial"  # suffix of what is not finished
_REFUSALS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # of a disk, which reading never gives


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Raise `ManipError` that names the file, else `path`, if the disk has no space or is read-only."""
    try:
        yield
    except OSError as error:  # those of Arrow and FFmpeg are, too
        if error.errno not in _REFUSALS:
            raise
        raise ManipError(f"cannot write {error.filename or path}: {os.strerror(error.errno)}") from error


@contextlib.contextmanager
def new_folder(root: Path, *, replace: bool = False) -> Generator[Path]:
    """Give an empty sibling of `root` to write into; on leaving, sync it to disk and rename it to `root`.

    An exception removes the sibling; what a killed writer left of one is removed by the next writer.
    Raises `FolderExistsError` if `root` holds something, before and after; with `replace` that stays until the
    new folder is whole, and is removed then. Raises `ManipError` if the disk is full or read-only.
    """
    root = root.absolute()
    if not (replace and root.is_dir()):
        _refuse_full(root)
    with writing(root):
        root.parent.mkdir(parents=True, exist_ok=True)
        for left in root.parent.glob(f".{root.name}.*{PARTIAL}"):
            lock = os.open(left, os.O_RDONLY)
            if _try_lock(lock):  # refused while its writer lives
                shutil.rmtree(left, ignore_errors=True)
            os.close(lock)
        partial = _partial(root)
        partial.mkdir()
    lock = os.open(partial, os.O_RDONLY)
    _try_lock(lock)  # the kernel lets go when the writer dies: so leftovers are known
    try:
        with writing(root):
            yield partial
            _libc("syncfs", lock)  # in one call, however many files it has
        if replace and root.exists():
            here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE: there is no moment without `root`
            _libc("renameat2", here, os.fsencode(partial), here, os.fsencode(root), exchange)
            shutil.rmtree(partial, ignore_errors=True)
        else:
            _refuse_full(root)
            partial.rename(root)
        sync(root.parent)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    finally:
        os.close(lock)


@contextlib.contextmanager
def exclusive(folder: Path) -> Generator[None]:
    """Hold `folder`, which need not exist, for this process; others see a file `.<name>.lock` beside it.

    If nothing may be written beside it (a container's volume), it is not held. Raises `ManipError`, with the
    holder's process id, if another process holds it. The kernel lets go of what a killed process held.
    """
    path = folder.absolute().with_name(f".{folder.absolute().name}.lock")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = _hold(folder, path)
    try:
        yield
    finally:
        if handle is not None:
            path.unlink(missing_ok=True)  # while it is held, so that nobody else's is removed
            os.close(handle)


def _hold(folder: Path, path: Path) -> int | None:
    """Return the lock file, open and locked; None if it may not be written."""
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
    """Write `data` to `path` so that `path` holds all of it or what it held before.

    Its folder is made. Raises `ManipError` if the disk is full or read-only.
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
        sync(path.parent)  # else a power cut may take the new name back


def sync(path: Path) -> None:
    """Have the disk hold a file's content, or a folder's list of names."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _partial(path: Path) -> Path:
    """A sibling that nobody else has."""
    return path.with_name(f".{path.name}.{os.urandom(6).hex()}{PARTIAL}")


def _try_lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed; return False if another process holds it."""
    with contextlib.suppress(OSError):  # of a cluster's file system that knows no locks
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _libc(name: str, *arguments: int | bytes) -> None:
    """Call a function of Linux's C library that Python does not have."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _refuse_full(root: Path) -> None:
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise FolderExistsError(root)
