"""Objects in a folder of this machine, or one mounted from another: `file:///mnt/store/demos`."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import itertools
import os
import secrets
import shutil
import stat
import time
from collections.abc import Generator, Iterable, Iterator, Mapping
from pathlib import Path

from manip_il.data.atomic import PARTIAL, exclusive, write_file
from manip_il.errors import FolderBusyError, UsageError
from manip_il.store.disk import copy_file, sync_disk
from manip_il.store.errors import AuthError, NoSpaceError, NotFoundError, RemoteError, TransientError
from manip_il.store.manifest import LONGEST_TEXT
from manip_il.store.object_store import OBJECTS, STALE, Stored, wrong_when_read
from manip_il.store.remote import MANIFEST_FILE, Advance, RemoteUrl, Sink

CHUNK = 2**20  # of what is copied at a time [bytes]
LOCK_WAIT = 30.0  # how long another push may take to switch over [s]


class FileBlobs:
    """`Blobs` in a folder. The kernel's locks keep two pushes apart; a killed process keeps none."""

    threads = 2  # more of them only wait for Python's lock

    def __init__(self, url: RemoteUrl):
        self.root, self.name = Path(url.place).expanduser(), str(url)
        self._folders: set[str] = set()
        self.warnings: tuple[str, ...] = ()

    def manifest(self) -> tuple[bytes, str] | None:
        """Return content and its hash."""
        with self._translated(f"read {self.name}"):
            try:
                with (self.root / MANIFEST_FILE).open("rb") as file:
                    data = file.read(LONGEST_TEXT + 1)
            except (FileNotFoundError, NotADirectoryError):
                return None
            return data, hashlib.sha256(data).hexdigest()

    def prepare(self, size: int) -> None:
        """Make the folder; refuse one that holds something else or lacks space."""
        with self._translated(f"write to {self.name}"):
            if self.root.exists() and not self.root.is_dir():
                raise UsageError(f"{self.name} is a file; expected a folder, or a name that is free")
            self.root.mkdir(parents=True, exist_ok=True)
            names = {name for name in os.listdir(self.root) if not name.startswith(".")}
            if names and not names & {MANIFEST_FILE, OBJECTS}:
                raise UsageError(f"{self.name} holds other files; name an empty or a new folder to push to")
            (self.root / OBJECTS).mkdir(exist_ok=True)
            free = shutil.disk_usage(self.root).free
        if size > free:
            text = f"{self.name} has {free:,} bytes left, {size:,} are to be uploaded"
            raise NoSpaceError(f"{text}; make room there, or push to another place")
        self._check_locks()

    def swap(self, data: bytes, before: str | None, needed: Mapping[str, int]) -> str | None:
        """Replace the manifest if it still has the token `before`, and return its own; else None."""
        with self._translated(f"write to {self.name}"), self._locked():
            found = self.manifest()
            if (found[1] if found else None) != before:
                return None
            for key, size in needed.items():
                if self._size(key) != size:
                    raise TransientError(f"{self.name} has lost the object {key[:12]}")
            sync_disk(self.root)  # the objects reach the disk before the manifest that names them
            write_file(self.root / MANIFEST_FILE, data)
        return hashlib.sha256(data).hexdigest()

    def fetch(self, key: str, target: Sink, offset: int) -> None:
        """Copy an object from `offset` on."""
        with self._translated(f"read {self.name}"):
            try:
                handle = os.open(self._path(key), os.O_RDONLY | os.O_NOFOLLOW)
            except FileNotFoundError:
                raise NotFoundError(f"{self.name} has no object {key[:12]}") from None
            with os.fdopen(handle, "rb", buffering=0) as file:
                file.seek(offset)
                size = min(CHUNK, os.fstat(handle).st_size)
                rooms = itertools.cycle([memoryview(bytearray(size)), memoryview(bytearray(size))])
                # Two in turn, as the target may still use the last one.
                while count := file.readinto(room := next(rooms)):
                    target.write(room[:count])

    def put(self, key: str, source: Path, size: int, advance: Advance) -> bool:
        """Copy, read back, rename."""
        self._copy(source, key)
        advance(size)
        return True

    def take(self, source: Path) -> tuple[int, str]:
        """Copy, read back, rename to the sha256 of what was read."""
        before = source.stat()
        key, after = self._copy(source, None), source.stat()
        if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
            raise TransientError(f"{source} changed while it was being pushed")
        return after.st_size, key

    def _copy(self, source: Path, expected: str | None) -> str:
        """Make an object of a file; return its key. Raises `TransientError` for another one than is expected."""
        with self._translated(f"write to {self.name}"):
            partial = f"{self._folder(expected or '00')}/.{secrets.token_hex(9)}{PARTIAL}"
            try:
                key = copy_file(source, partial)
                if expected not in (None, key):
                    text = f"{source} changed while it was being pushed, or {self.name} did not store it intact"
                    raise TransientError(text)
                os.replace(partial, f"{self._folder(key)}/{key}")
            except BaseException:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(partial)
                raise
        return key

    def _folder(self, key: str) -> str:
        """The folder of an object, which is made."""
        folder = f"{self.root}/{OBJECTS}/{key[:2]}"
        if folder not in self._folders:
            os.makedirs(folder, exist_ok=True)
            self._folders.add(folder)
        return folder

    def find(self, keys: Iterable[str]) -> dict[str, Stored]:
        """Return those of `keys` that are there."""
        now, found = time.time(), dict[str, Stored]()
        for key in keys:
            with contextlib.suppress(OSError):
                status = self._path(key).lstat()
                if stat.S_ISREG(status.st_mode):  # what else has the name is replaced
                    found[key] = Stored(status.st_size, now - status.st_mtime)
        return found

    def list(self) -> dict[str, Stored]:
        """Return every object."""
        return self.find(path.name for path in self._all() if not path.name.startswith("."))

    def wrong(self, sizes: Mapping[str, int]) -> set[str]:
        """Return those that are missing or have other bytes."""
        return wrong_when_read(self, sizes)

    def remove(self, keys: Iterable[str], token: str) -> None:
        """Remove objects, and what killed pushes left, unless another push has been."""
        with self._translated(f"write to {self.name}"), self._locked():
            found = self.manifest()
            if found is None or found[1] != token:
                return
            for key in keys:
                self._path(key).unlink(missing_ok=True)
            for path in self._all():
                if path.name.startswith(".") and time.time() - path.lstat().st_mtime > STALE:
                    path.unlink(missing_ok=True)

    def _path(self, key: str) -> Path:
        return self.root / OBJECTS / key[:2] / key

    def _size(self, key: str) -> int | None:
        try:
            return self._path(key).lstat().st_size
        except FileNotFoundError:
            return None

    def _all(self) -> Iterator[Path]:
        return (self.root / OBJECTS).glob("??/*")

    @contextlib.contextmanager
    def _locked(self) -> Generator[None]:
        last = time.monotonic() + LOCK_WAIT
        while True:
            try:
                stack = contextlib.ExitStack()
                stack.enter_context(exclusive(self.root / MANIFEST_FILE))
                break
            except FolderBusyError:
                if time.monotonic() > last:
                    raise RemoteError(f"another push is updating {self.name}; wait, and push again") from None
                time.sleep(0.05)
        with stack:
            yield

    def _check_locks(self) -> None:
        handle = os.open(self.root, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_SH)
        except OSError:
            text = f"{self.name} is on a file system without locks: two pushes at once can overwrite each other"
            self.warnings = (text,)
        finally:
            os.close(handle)

    @contextlib.contextmanager
    def _translated(self, what: str) -> Generator[None]:
        try:
            yield
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise NoSpaceError(f"cannot {what}: the disk is full; make room there and push again") from None
            if isinstance(error, PermissionError) or error.errno == errno.EROFS:
                text = f"cannot {what}: {error.strerror}; ask its owner for permission, or choose another place"
                raise AuthError(text) from None
            if error.errno in (errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EINTR):
                raise TransientError(f"cannot {what}: {error.strerror}") from None
            raise RemoteError(f"cannot {what}: {error.strerror or error}; check that folder") from None
