"""Files on this machine's disks: copied, hashed and synced, and downloads that continue where they were cut."""

from __future__ import annotations

import ctypes
import errno
import hashlib
import io
import os
from collections.abc import Buffer, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il import checks
from manip_il.store.errors import HashError, NoSpaceError, RemoteError, TransientError
from manip_il.store.manifest import FileEntry
from manip_il.store.remote import Advance

if TYPE_CHECKING:
    from _hashlib import HASH  # what hashlib's constructors return

HASHERS = 4  # threads: hashlib lets go of Python's lock
CHUNK = 2**20  # of what is copied or hashed at a time [bytes]
_START = 2  # SYNC_FILE_RANGE_WRITE
_WORTH_A_THREAD = 2**17  # of a chunk that is hashed beside the writing [bytes]
_WORTH_A_SYNC = 2**25  # that the kernel is asked at once to bring to the disk [bytes]


def hash_file(path: Path, digest: HASH) -> int:
    """Feed a file's bytes to `digest`; return their number."""
    with open(checks.open_regular(path), "rb", buffering=0) as file:
        hashlib.file_digest(file, lambda: digest)
        return file.tell()


def sized_and_hashed(path: Path) -> tuple[int, str]:
    """Return a file's size [bytes] and sha256."""
    digest = hashlib.sha256()
    return hash_file(path, digest), digest.hexdigest()


def copy_file(source: Path, target: str) -> str:
    """Copy into a new file; return the sha256 of the copy, read back."""
    with source.open("rb", buffering=0) as old, open(target, "x+b", buffering=0) as new:
        if os.fstat(old.fileno()).st_size > CHUNK:
            return _copy_large(old.fileno(), new.fileno())
        write_all(new, old.read())
        new.seek(0)
        return hashlib.file_digest(new, "sha256").hexdigest()


def _copy_large(old: int, new: int) -> str:
    """Copy in one thread; read back and hash in another."""
    digest, room = hashlib.sha256(), memoryview(bytearray(CHUNK))

    def read_back(offset: int, end: int) -> None:
        start_writing(new, offset, end - offset)
        while offset < end:
            count = os.preadv(new, [room[: end - offset]], offset)
            if not count:
                raise OSError(f"the copy ended after {offset:,} bytes")
            digest.update(room[:count])
            offset += count

    with ThreadPoolExecutor(1) as pool:
        offset, running = 0, list[Future[None]]()
        while count := os.sendfile(new, old, None, CHUNK):
            running.append(pool.submit(read_back, offset, offset + count))
            offset += count
        for future in running:
            future.result()
    return digest.hexdigest()


def write_all(file: io.RawIOBase, data: Buffer) -> None:
    """Write to an unbuffered file, which may take less at a time."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) or 0 :]


def start_writing(handle: int, offset: int, size: int) -> None:
    """Have the kernel begin to write a part of a file to its disk, so that a later sync has less to do (Linux)."""
    if _sync_file_range is not None:
        _sync_file_range(handle, ctypes.c_int64(offset), ctypes.c_int64(size), _START)


def sync_disk(folder: Path) -> None:
    """Write everything to the disk of `folder`: one call for any number of files (Linux)."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        if _LIBC.syncfs(handle):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    finally:
        os.close(handle)


class Download:
    """Brings the bytes of `entry` into the file `part`, one try after another; a `Sink` for the remote's `fetch`."""

    def __init__(self, entry: FileEntry, part: Path, advance: Advance):
        self._entry, self._part, self._advance = entry, part, advance
        self._counted = 0  # bytes that `advance` has been given
        self._mismatches = 0
        self._hashed: Future[None] | None = None  # of the last write, which may still run

    def attempt(self, fetch: Callable[[Download, int], None]) -> None:
        """Run one try, from where the last one stopped. Raises `TransientError` if another try may help.

        fetch: writes the bytes from an offset on.
        """
        entry, part = self._entry, self._part
        handle = checks.open_regular(part, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        with open(handle, "ab", buffering=0) as self._file, ThreadPoolExecutor(2) as self._helper:
            if os.fstat(handle).st_size > entry.size:
                self._file.truncate(0)
            self._digest, self._hashed = _digest_for(entry), None
            self._position = hash_file(part, self._digest)
            self._syncing = self._position  # up to here the kernel was asked to bring bytes to the disk
            self._count()
            if self._position < entry.size:
                fetch(self, self._position)
        if self._position != entry.size:
            raise TransientError(f"{entry.path} ended after {self._position:,} of {entry.size:,} bytes")
        if self._digest.hexdigest() != (entry.sha256 or entry.git_sha1):
            part.unlink()
            self._mismatches += 1
            text = f"{entry.path} does not match the manifest: its hash differs"
            if self._mismatches > 1:
                raise HashError(f"{text}, twice; nothing was kept; push it again, to an empty folder")
            raise TransientError(text)

    def write(self, data: bytes | memoryview, /) -> None:
        """Take the next bytes; their memory is free again when the next call has returned."""
        chunk = memoryview(data)
        if self._position + len(chunk) > self._entry.size:
            text = f"{self._entry.path} is longer than the {self._entry.size:,} bytes of the manifest"
            raise HashError(f"{text}; nothing was kept; push it again, to an empty folder")
        if self._hashed is not None:
            self._hashed.result()
        # A large chunk is hashed while it is written and the next one is fetched.
        is_large = len(chunk) >= _WORTH_A_THREAD
        self._hashed = self._helper.submit(self._digest.update, chunk) if is_large else None
        if not is_large:
            self._digest.update(chunk)
        try:
            write_all(self._file, chunk)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                text = "the disk is full; make room and pull again: what has been transferred is kept"
                raise NoSpaceError(text) from None
            raise RemoteError(f"cannot write {self._entry.path}: {error.strerror}; check that disk") from None
        self._position += len(chunk)
        if (size := self._position - self._syncing) >= _WORTH_A_SYNC:
            self._helper.submit(start_writing, self._file.fileno(), self._syncing, size)
            self._syncing = self._position
        self._count()

    def _count(self) -> None:
        if self._position > self._counted:
            self._advance(self._position - self._counted)
            self._counted = self._position


def is_whole(entry: FileEntry, path: Path) -> bool:
    """Return whether a plain file holds the bytes of an entry."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size != entry.size:
        return False
    digest = _digest_for(entry)
    hash_file(path, digest)
    return digest.hexdigest() == (entry.sha256 or entry.git_sha1)


def _digest_for(entry: FileEntry) -> HASH:
    return hashlib.sha256() if entry.sha256 else git_digest(entry.size)


def git_digest(size: int) -> HASH:
    """Begin git's id of a file of `size` bytes (`git hash-object`)."""
    return hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)


_LIBC = ctypes.CDLL(None, use_errno=True)
_sync_file_range = getattr(_LIBC, "sync_file_range", None)
