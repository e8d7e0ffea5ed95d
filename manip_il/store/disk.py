"""Files of this machine's disks: copied and hashed at once, and brought down to the disk."""

from __future__ import annotations

import ctypes
import hashlib
import io
import os
from collections.abc import Buffer
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, Protocol

CHUNK = 2**20  # of what is copied or hashed at a time [bytes]
_START = 2  # SYNC_FILE_RANGE_WRITE


class Hasher(Protocol):
    """What `hashlib` makes."""

    def update(self, data: Buffer, /) -> None:
        """Feed bytes."""
        ...

    def hexdigest(self) -> str:
        """Return the hash of all that was fed."""
        ...


def hash_file(path: Path | str, digest: Hasher) -> int:
    """Feed a file's bytes to `digest`; return how many they were."""
    with open(path, "rb", buffering=0) as file:
        total = 0
        room = memoryview(bytearray(min(CHUNK, os.fstat(file.fileno()).st_size + 1)))
        while count := file.readinto(room):
            digest.update(room[:count])
            total += count
    return total


def copy_file(source: Path, target: str) -> str:
    """Copy into a new file; return the sha256 of the copy, as it was read back."""
    with source.open("rb", buffering=0) as old, open(target, "x+b", buffering=0) as new:
        if os.fstat(old.fileno()).st_size > CHUNK:
            return _copy_large(old.fileno(), new.fileno())
        while data := old.read(CHUNK):
            write_all(new, data)
        new.seek(0)
        digest = hashlib.sha256()
        while data := new.read(CHUNK):
            digest.update(data)
    return digest.hexdigest()


def _copy_large(old: int, new: int) -> str:
    """One thread copies, another one reads back and hashes what has been copied."""
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


def write_all(file: io.RawIOBase | BinaryIO, data: Buffer) -> None:
    """Write to an unbuffered file, which may take less at a time."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) or 0 :]


def start_writing(handle: int, offset: int, size: int) -> None:
    """Have the kernel begin to bring a part of a file to its disk, so that a sync later has less to do (Linux)."""
    if _sync_file_range is not None:
        _sync_file_range(handle, ctypes.c_int64(offset), ctypes.c_int64(size), _START)


def sync_disk(folder: Path) -> None:
    """Have the disk beneath `folder` hold all that was written to it: one call for any number of files (Linux)."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        if _LIBC.syncfs(handle):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    finally:
        os.close(handle)


_LIBC = ctypes.CDLL(None, use_errno=True)
_sync_file_range = getattr(_LIBC, "sync_file_range", None)
