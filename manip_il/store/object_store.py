"""A `Remote` on any store of plain files: objects named by their hash, and one manifest.

    PLACE/manip_il_manifest.json       replaced last, in one step: readers see the old version or the new one
         /objects/3f/3f9a...           every file's bytes, by their sha256; never changed

Objects of the replaced version stay until the next push, so that whoever is reading it can finish.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

from manip_il.store.errors import ConflictError, HashError, ManifestError, NotFoundError, RemoteError, Retry
from manip_il.store.manifest import FileEntry, Manifest
from manip_il.store.remote import Advance, Intake, Published, Sink, Snapshot

OBJECTS = "objects"  # folder of the objects
STALE = 24 * 3600.0  # an object that no version names is removed from this age on: no push takes so long [s]
FRESH = 12 * 3600.0  # an object that no version names is used again up to this age [s]
FEW = 32  # up to so many objects are queried one by one; more are listed


@dataclass(frozen=True)
class Stored:
    """An object on the store. size [bytes]. age: since it was written, by the store's clock [s]."""

    size: int
    age: float


class Blobs(Protocol):
    """A store of objects, named by the sha256 of their bytes (their key), and of one manifest.

    The manifest's token is opaque; another content has another one. Methods raise errors of `manip_il.store.errors`:
    `TransientError` if another try may help.
    """

    name: str  # of the place, for messages
    threads: int  # that may use it at a time
    warnings: tuple[str, ...]  # for the user

    def manifest(self) -> tuple[bytes, str] | None:
        """Return content and token; None if there is none."""
        ...

    def prepare(self, size: int) -> None:
        """Check, before `size` bytes are uploaded, that the place holds nothing else and has room."""
        ...

    def swap(self, data: bytes, before: str | None, needed: Mapping[str, int]) -> str | None:
        """Replace the manifest in one step if its token is still `before`; return the new token, else None.

        needed: keys and sizes of the objects that must be there.
        """
        ...

    def fetch(self, key: str, target: Sink, offset: int) -> None:
        """Write an object's bytes from `offset` on to `target`. Raises `NotFoundError` if it is gone."""
        ...

    def put(self, key: str, source: Path, size: int, advance: Advance) -> bool:
        """Store an object, whole or not at all; return whether it was verified."""
        ...

    def find(self, keys: Iterable[str]) -> dict[str, Stored]:
        """Return those of `keys` that are there."""
        ...

    def list(self) -> dict[str, Stored]:
        """Return every object."""
        ...

    def wrong(self, sizes: Mapping[str, int]) -> set[str]:
        """Return those of the keys whose objects are missing or have other bytes."""
        ...

    def remove(self, keys: Iterable[str], token: str) -> None:
        """Remove objects, and what killed pushes left, unless the manifest's token is no longer `token`."""
        ...


@runtime_checkable
class TakesUnhashed(Protocol):
    """A store of objects that need not be told an object's key: it hashes what it stores."""

    def take(self, source: Path) -> tuple[int, str]:
        """Store a file as an object, whole or not at all, and verified; return its size [bytes] and key."""
        ...


@dataclass
class ObjectRemote:
    """A `Remote` on top of `Blobs`."""

    blobs: Blobs
    retry: Retry = field(default_factory=Retry)
    _taken: set[str] = field(default_factory=set[str])  # keys of the objects that came in unhashed

    def __post_init__(self) -> None:
        self.name, self.threads = self.blobs.name, self.blobs.threads

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about this store, as far as they are known by now."""
        return self.blobs.warnings

    def read(self) -> Snapshot | None:
        """Return the version that is there; None if there is none."""
        found = self.retry(self.blobs.manifest)
        if found is None:
            return None
        data, token = found
        try:
            manifest = Manifest.from_json(data)
            for entry in manifest.files:
                if not entry.sha256:
                    raise ManifestError(f"{entry.path!r:.200} has no sha256")
        except ManifestError as error:
            raise ManifestError(f"{self.name}: {error}") from None
        return Snapshot(manifest, token)

    def fetch(self, snapshot: Snapshot, entry: FileEntry, target: Sink, offset: int) -> None:
        """Write the bytes of one file from `offset` on to `target`, in one try."""
        self.blobs.fetch(entry.sha256, target, offset)

    def intake(self, before: Snapshot | None, size: int) -> Intake | None:
        """Make ready to take files unhashed, where the store can and holds no object yet."""
        blobs = self.blobs
        if before is not None or not isinstance(blobs, TakesUnhashed):
            return None
        self.retry(lambda: blobs.prepare(size))
        if self.retry(self.blobs.list):
            return None  # of a push that was cut off: only what is missing is copied

        def take(source: Path) -> tuple[int, str]:
            taken = self.retry(lambda: blobs.take(source))
            self._taken.add(taken[1])
            return taken

        return take

    def publish(
        self, local: Mapping[str, Path], manifest: Manifest, before: Snapshot | None, progress: Advance
    ) -> Published:
        """Upload, verify, switch, remove old objects; objects that the store has lost are uploaded again."""
        known, taken = before.manifest.keys if before else frozenset[str](), self._taken
        self._taken = set()
        is_same = bool(before) and (before.manifest.kind, before.manifest.files) == (manifest.kind, manifest.files)
        sizes = {entry.sha256: entry.size for entry in manifest.files}
        sources = {entry.sha256: local[entry.path] for entry in manifest.files}
        new = {key: size for key, size in sizes.items() if key not in known}
        if not is_same:
            self.retry(lambda: self.blobs.prepare(sum(new[key] for key in new.keys() - taken)))
        stored = self._stored(sizes)
        usable = {
            key for key, one in stored.items() if one.size == sizes.get(key) and (key in known or one.age < FRESH)
        }
        missing = {key: size for key, size in sizes.items() if key not in usable}
        to_send = {key: size for key, size in new.items() if key in missing}
        progress(sum(entry.size for entry in manifest.files if entry.sha256 in new) - sum(to_send.values()))
        verified = taken | self._upload(to_send, sources, progress)
        verified |= self._upload({key: size for key, size in missing.items() if key in known}, sources, lambda _: None)
        self._verify({key: size for key, size in (new | missing).items() if key not in verified}, sources)
        sent = missing.keys() | taken
        uploaded = sum(entry.sha256 in sent for entry in manifest.files)
        kept, size = len(manifest.files) - uploaded, sum(sizes[key] for key in sizes.keys() & sent)
        if before and is_same:
            return Published(uploaded, size, kept, 0, before.token)
        token = self._switch(manifest, before, sizes, sources)
        self._clear(manifest, before, stored, token)
        gone = set(before.manifest.by_path if before else ()) - manifest.by_path.keys()
        return Published(uploaded, size, kept, len(gone), token)

    def _stored(self, sizes: Mapping[str, int]) -> dict[str, Stored]:
        return self.retry(lambda: self.blobs.find(sizes) if len(sizes) <= FEW else self.blobs.list())

    def _upload(self, sizes: Mapping[str, int], sources: Mapping[str, Path], progress: Advance) -> set[str]:
        """Put objects; return those that the store has verified."""

        def one(key: str) -> bool:
            most = 0  # bytes in one try: what is sent again counts once

            def put() -> bool:
                sent = 0

                def advance(count: int) -> None:
                    nonlocal sent, most
                    sent += count
                    if sent > most:
                        progress(sent - most)
                        most = sent

                return self.blobs.put(key, sources[key], sizes[key], advance)

            return self.retry(put)

        largest_first = sorted(sizes, key=lambda key: -sizes[key])  # else the last one runs alone
        done = in_threads(self.blobs.threads, one, largest_first)
        return {key for key, verified in done.items() if verified}

    def _verify(self, sizes: Mapping[str, int], sources: Mapping[str, Path]) -> None:
        """Have the store check the objects' bytes; put wrong ones once more. Raises `HashError` for a second time."""
        wrong = self.retry(lambda: self.blobs.wrong(sizes)) if sizes else set[str]()
        if not wrong:
            return
        again = {key: sizes[key] for key in wrong}
        verified = self._upload(again, sources, lambda _: None)
        left = {key: size for key, size in again.items() if key not in verified}
        if left and self.retry(lambda: self.blobs.wrong(left)):
            text = f"{self.name} twice did not keep the bytes that were sent; nothing was published"
            raise HashError(f"{text}: check its disk and the network")

    def _switch(
        self, manifest: Manifest, before: Snapshot | None, sizes: Mapping[str, int], sources: Mapping[str, Path]
    ) -> str:
        """Replace the manifest; return its token."""
        replaced = sorted(before.manifest.keys - manifest.keys) if before else []
        data = replace(manifest, replaced=tuple(replaced)).to_json()

        def swap() -> str:
            token = self.blobs.swap(data, before.token if before else None, sizes)
            if token is not None:
                return token
            found = self.blobs.manifest()
            if found and found[0] == data:
                return found[1]  # an earlier try, maybe of the HTTP client's own, had worked: only its answer was lost
            raise ConflictError(self.name)

        token = self.retry(swap)
        if before is None:  # then no other push can have removed anything
            return token
        # A store without locks may have let another push remove an object that this one found there.
        lost = set(sizes) - self._stored(sizes).keys()
        if lost:
            self._upload({key: sizes[key] for key in lost}, sources, lambda _: None)
        return token

    def _clear(self, manifest: Manifest, before: Snapshot | None, stored: Mapping[str, Stored], token: str) -> None:
        """Remove what the version before the last one named, and what pushes that were given up have left."""
        needed = manifest.keys | (before.manifest.keys if before else frozenset[str]())
        doomed = set(before.manifest.replaced if before else ())
        doomed |= {key for key, one in stored.items() if one.age > STALE}
        try:
            if doomed - needed:
                self.blobs.remove(sorted(doomed - needed), token)
        except RemoteError as error:  # readers see the new version already: the push has worked
            self.blobs.warnings += (f"old files could not be removed ({error}); the next push tries again",)


def in_threads[K, R](threads: int, work: Callable[[K], R], keys: Iterable[K]) -> dict[K, R]:
    """Run `work` on every key; raise its first error when what runs already has ended.

    Ctrl-C waits for nothing: a large file may take minutes yet.
    """
    stop, is_interrupted = threading.Event(), False

    def one(key: K) -> R | None:
        return None if stop.is_set() else work(key)

    pool = ThreadPoolExecutor(threads)
    try:
        futures: dict[K, Future[R | None]] = {key: pool.submit(one, key) for key in keys}
        done, _ = wait(futures.values(), return_when="FIRST_EXCEPTION")
        problem = next((future.exception() for future in done if future.exception()), None)
        if problem is not None:
            raise problem
        return {key: cast("R", future.result()) for key, future in futures.items()}
    except BaseException as error:
        stop.set()
        is_interrupted = isinstance(error, KeyboardInterrupt)
        raise
    finally:
        pool.shutdown(wait=not is_interrupted, cancel_futures=True)


def wrong_when_read(blobs: Blobs, keys: Iterable[str]) -> set[str]:
    """Read objects back; return the keys of those that are gone or have other bytes."""

    def one(key: str) -> bool:
        digest = _Digest()
        try:
            blobs.fetch(key, digest, 0)
        except NotFoundError:
            return True
        return digest.sha256.hexdigest() != key

    return {key for key, is_wrong in in_threads(blobs.threads, one, keys).items() if is_wrong}


class _Digest:
    def __init__(self) -> None:
        self.sha256 = hashlib.sha256()

    def write(self, data: bytes | memoryview, /) -> None:
        self.sha256.update(data)
