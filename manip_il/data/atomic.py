"""Write files and folders atomically, and name the path if a disk is full or read-only."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import json
import os
import re
import shutil
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any

from manip_il.data.ownership import PARTIAL, UNFINISHED, UNFINISHED_MARK, require_replaceable
from manip_il.errors import ManipError

_WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)  # never raised by reading


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Raise `ManipError` if the disk is full or read-only. It names the file that failed, or `path` if unknown."""
    try:
        yield
    except Exception as error:
        # errors of Arrow and FFmpeg are OSErrors, too; those of safetensors only name the number
        named = re.search(r"os error (\d+)", str(error))
        number = getattr(error, "errno", None) or (int(named[1]) if named else None)
        if number not in _WRITE_ERRORS:
            raise
        place = getattr(error, "filename", None) or path
        raise ManipError(f"cannot write {place}: {os.strerror(number)}") from error


@contextlib.contextmanager
def new_folder(root: Path, *, replaces: str = "") -> Generator[Path]:
    """Yield an empty folder beside `root` to write into; at the end, sync it to disk and rename it to `root`.

    It is in `.NAME.partial`, which an exception removes, and which the next writer empties if a killed process left it.
    Raises `ManipError` if the disk is full or read-only, or if another process writes the same folder.

    Args:
        root: The new folder. It must not exist or be empty, at the beginning and at the end.
        replaces: Kind of folder whose place it may take instead, as `kind_of` names it.
    """
    root = root.absolute()
    require_replaceable(root, replaces)
    partial = root.with_name(f".{root.name}{PARTIAL}")
    if partial.is_symlink():  # a planted link: its target must not be cleared
        partial.unlink()
    new, mark = partial / root.name, partial / UNFINISHED_MARK
    with writing(root), exclusive(partial) as handle:
        require_replaceable(partial, UNFINISHED)
        mark.touch()
        clear(partial, keep=mark)
        new.mkdir()
        try:
            yield new
            _libc("syncfs", handle)  # one call for all files
            require_replaceable(root, replaces)
            if replaces and root.exists():
                # AT_FDCWD and RENAME_EXCHANGE: `root` exists at every moment
                here, exchange = -100, 2
                _libc("renameat2", here, os.fsencode(new), here, os.fsencode(root), exchange)
            else:
                new.rename(root)
            sync(root.parent)
        finally:
            shutil.rmtree(new, ignore_errors=True)
            mark.unlink(missing_ok=True)  # last, so that a kill leaves nothing that is not marked


@contextlib.contextmanager
def exclusive(folder: Path) -> Generator[int]:
    """Lock `folder` for this process, creating it if it does not exist; yield its file descriptor.

    The kernel releases the locks of a killed process. Raises `ManipError` if another process holds the lock.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = f"{folder} is in use by another process; wait until that is done, or choose another folder"
            raise ManipError(text) from error
        except OSError:  # a cluster's file system may not support locks
            pass
        try:
            yield handle
        finally:
            with contextlib.suppress(OSError):
                folder.rmdir()  # if nothing was written
    finally:
        os.close(handle)


def clear(folder: Path, keep: Path | None = None) -> None:
    """Delete everything in a folder except `keep`, but not the folder itself, which may be locked or a mount point."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path != keep:
            path.unlink()


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


def _libc(name: str, *arguments: int | bytes) -> None:
    """Call a function of Linux's C library that Python does not wrap."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
