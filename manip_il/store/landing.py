"""One file on its way here: kept between tries, counted, hashed, and refused where it is not what was promised."""

from __future__ import annotations

import errno
import hashlib
import io
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, cast

from manip_il.store.disk import Hasher, hash_file, start_writing, write_all
from manip_il.store.errors import HashError, NoSpaceError, RemoteError, TransientError
from manip_il.store.manifest import FileEntry
from manip_il.store.remote import Advance

_WORTH_A_THREAD = 2**17  # that are hashed beside the writing [bytes]
_WORTH_A_START = 2**25  # that the kernel is asked at once to bring to the disk [bytes]

Fetch = Callable[[BinaryIO, int], None]  # writes the bytes from an offset on


class Landing:
    """Brings the bytes of `entry` into the file `part`, a try at a time."""

    def __init__(self, entry: FileEntry, part: Path, advance: Advance):
        self._entry, self._part, self._advance = entry, part, advance
        self._counted = 0
        self._mismatches = 0

    def once(self, fetch: Fetch) -> None:
        """Go on where the last try stopped. Raises `TransientError` where another try may help."""
        entry, part = self._entry, self._part
        with part.open("ab", buffering=0) as file, ThreadPoolExecutor(2) as helper:
            digest = hasher(entry)
            offset = self._hash_what_is_there(digest)
            self._count(offset)
            incoming = _Incoming(file, digest, entry, offset, self._count, helper)
            if offset < entry.size:
                fetch(cast("BinaryIO", incoming), offset)
        if incoming.position != entry.size:
            raise TransientError(f"{entry.path} ended after {incoming.position:,} of {entry.size:,} bytes")
        if digest.hexdigest() != (entry.sha256 or entry.git_sha1):
            part.unlink()
            self._mismatches += 1
            text = f"{entry.path} does not match the manifest: its hash differs"
            if self._mismatches > 1:
                raise HashError(f"{text}, twice; nothing was kept; push it again, to an empty folder")
            raise TransientError(text)

    def _hash_what_is_there(self, digest: Hasher) -> int:
        size = self._part.stat().st_size
        if size > self._entry.size:
            self._part.write_bytes(b"")
            return 0
        return hash_file(self._part, digest) if size else 0

    def _count(self, position: int) -> None:
        if position > self._counted:
            self._advance(position - self._counted)
            self._counted = position


def hasher(entry: FileEntry) -> Hasher:
    """What the bytes of an entry are fed to."""
    if entry.sha256:
        return hashlib.sha256()
    return hashlib.sha1(b"blob %d\0" % entry.size, usedforsecurity=False)


def is_whole(entry: FileEntry, path: Path) -> bool:
    """Return whether a plain file holds the bytes of an entry."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size != entry.size:
        return False
    digest = hasher(entry)
    hash_file(path, digest)
    return digest.hexdigest() == (entry.sha256 or entry.git_sha1)


class _Incoming(io.RawIOBase):
    """What stores write to; they may use the memory of one write again when the next one has returned."""

    def __init__(
        self,
        file: io.RawIOBase,
        digest: Hasher,
        entry: FileEntry,
        offset: int,
        count: Advance,
        helper: ThreadPoolExecutor,
    ):
        super().__init__()
        self._file, self._digest, self._entry, self._count, self._helper = file, digest, entry, count, helper
        self._hashed: Future[None] | None = None
        self._on_its_way = self.position = offset

    def writable(self) -> bool:
        return True

    def write(self, data: object, /) -> int:
        chunk = memoryview(cast("bytes", data))
        if self.position + len(chunk) > self._entry.size:
            text = f"{self._entry.path} is longer than the {self._entry.size:,} bytes of the manifest"
            raise HashError(f"{text}; nothing was kept; push it again, to an empty folder")
        if self._hashed is not None:
            self._hashed.result()
        # A large one is hashed while it is written and the next one is fetched.
        is_large = len(chunk) >= _WORTH_A_THREAD
        self._hashed = self._helper.submit(self._digest.update, chunk) if is_large else None
        if not is_large:
            self._digest.update(chunk)
        self._write(chunk)
        self.position += len(chunk)
        self._count(self.position)
        return len(chunk)

    def _write(self, chunk: memoryview) -> None:
        try:
            write_all(self._file, chunk)
            end = self.position + len(chunk)
            if end - self._on_its_way >= _WORTH_A_START:
                self._helper.submit(start_writing, self._file.fileno(), self._on_its_way, end - self._on_its_way)
                self._on_its_way = end
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise NoSpaceError(
                    "the disk is full; make room and pull again: what has been transferred is kept"
                ) from None
            raise RemoteError(f"cannot write {self._entry.path}: {error.strerror}; check that disk") from None
