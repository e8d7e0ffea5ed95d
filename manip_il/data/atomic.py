"""Files and folders that are there whole or not at all, whatever kills the writer."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Generator
from pathlib import Path

from manip_il.errors import FolderExistsError

PARTIAL = ".partial"  # suffix of what is not finished


@contextlib.contextmanager
def new_folder(root: Path) -> Generator[Path]:
    """Give an empty sibling of `root` to write into; on leaving, sync it to disk and rename it to `root`.

    An exception removes the sibling; what a killed writer left of one is removed by the next writer.
    Raises `FolderExistsError` where `root` holds something, before and after.
    """
    root = root.absolute()
    _refuse_full(root)
    root.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(root)
    partial = Path(tempfile.mkdtemp(prefix=f".{root.name}.", suffix=PARTIAL, dir=root.parent))
    lock = os.open(partial, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # a network file system may know no locks; then leftovers stay
            fcntl.flock(lock, fcntl.LOCK_EX)  # the kernel lets go when the writer dies: so leftovers are known
        partial.chmod(0o777 & ~_umask())
        yield partial
        _sync_tree(partial)
        try:
            partial.rename(root)
        except OSError:
            _refuse_full(root)
            raise
        sync(root.parent)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    finally:
        os.close(lock)


def write_file(path: Path, data: bytes) -> None:
    """Write `data` to `path` so that `path` holds all of it or what it held before."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=PARTIAL, dir=path.parent)
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            os.fchmod(stream.fileno(), 0o666 & ~_umask())
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
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _sync_tree(folder: Path) -> None:
    for path in folder.rglob("*"):
        sync(path)
    sync(folder)


def _refuse_full(root: Path) -> None:
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise FolderExistsError(root)


def _remove_leftovers(root: Path) -> None:
    for partial in root.parent.glob(f".{root.name}.*{PARTIAL}"):
        with contextlib.suppress(OSError):
            lock = os.open(partial, os.O_RDONLY | os.O_DIRECTORY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # refused while its writer lives
                shutil.rmtree(partial, ignore_errors=True)
            finally:
                os.close(lock)


def _umask() -> int:
    mask = os.umask(0o077)  # there is no way to only read it
    os.umask(mask)
    return mask
