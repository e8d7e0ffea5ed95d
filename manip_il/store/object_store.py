"""A dataset or policy on a store of plain files: objects named by their hash, and one manifest that says what is seen.

    PLACE/manip_il_manifest.json       replaced last, in one step: readers see the old version or the new
         /objects/3f/3f9a...           every file's bytes, by their sha256; never changed

What the replaced version alone names stays until the next push, so that who is reading it can finish.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, cast

from manip_il.store.blobs import STALE, Blobs, Stored
from manip_il.store.errors import ConflictError, HashError, ManifestError, NotFoundError, RemoteError
from manip_il.store.manifest import FileEntry, Manifest
from manip_il.store.remote import Advance, Published, Snapshot
from manip_il.store.retry import Retry

FRESH = 12 * 3600.0  # an object that no version names is used again up to this age [s]
FEW = 32  # objects that are asked for one by one; more are listed


@dataclass
class ObjectRemote:
    """A `Remote` on top of `Blobs`."""

    blobs: Blobs
    retry: Retry = field(default_factory=Retry)

    @property
    def threads(self) -> int:
        """That may fetch at a time."""
        return self.blobs.threads

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the store has shown that it cannot do."""
        return self.blobs.warnings

    def describe(self) -> str:
        """Return the URL, without a password."""
        return self.blobs.describe()

    def read(self) -> Snapshot | None:
        """Return the manifest that is there; None where there is none."""
        found = self.retry(self.blobs.manifest)
        if found is None:
            return None
        data, token = found
        try:
            return Snapshot(_with_sha256(Manifest.from_json(data)), token)
        except ManifestError as error:
            raise ManifestError(f"{self.describe()}: {error}") from None

    def fetch(self, snapshot: Snapshot, entry: FileEntry, target: BinaryIO, offset: int) -> None:
        """Once: who calls knows how many bytes came, and goes on from there."""
        self.blobs.fetch(entry.sha256, target, offset)

    def publish(
        self, local: Mapping[str, Path], manifest: Manifest, before: Snapshot | None, progress: Advance
    ) -> Published:
        """Upload, verify, switch, clear away; what the store has lost of the version before is uploaded again."""
        known = before.manifest.keys if before else frozenset[str]()
        is_same = bool(before) and (before.manifest.kind, before.manifest.files) == (manifest.kind, manifest.files)
        sizes = {entry.sha256: entry.size for entry in manifest.files}
        sources = {entry.sha256: local[entry.path] for entry in manifest.files}
        new = {key: size for key, size in sizes.items() if key not in known}
        if not is_same:
            self.retry(lambda: self.blobs.prepare(sum(new.values())))
        stored = self._stored(sizes)
        missing = {key: size for key, size in sizes.items() if not _is_usable(stored.get(key), size, key in known)}
        to_send = {key: size for key, size in new.items() if key in missing}
        progress(sum(entry.size for entry in manifest.files if entry.sha256 in new) - sum(to_send.values()))
        verified = self._upload(to_send, sources, progress)
        verified |= self._upload({key: size for key, size in missing.items() if key in known}, sources, lambda _: None)
        self._verify({key: size for key, size in (new | missing).items() if key not in verified}, sources)
        uploaded = sum(entry.sha256 in missing for entry in manifest.files)
        kept, size = len(manifest.files) - uploaded, sum(missing.values())
        if before and is_same:
            return Published(uploaded, size, kept, 0, before.token)
        token = self._switch(manifest, before, sizes, sources)
        self._clear(manifest, before, stored, token)
        gone = set(before.manifest.by_path if before else ()) - manifest.by_path.keys()
        return Published(uploaded, size, kept, len(gone), token)

    def _stored(self, sizes: Mapping[str, int]) -> dict[str, Stored]:
        return self.retry(lambda: self.blobs.find(sizes) if len(sizes) <= FEW else self.blobs.list())

    def _upload(self, sizes: Mapping[str, int], sources: Mapping[str, Path], progress: Advance) -> set[str]:
        """Bring objects there; return those that the store has verified."""

        def one(key: str) -> bool:
            sent = _Sent(progress)
            return self.retry(lambda: self.blobs.put(key, sources[key], sizes[key], sent.again()))

        largest_first = sorted(sizes, key=lambda key: -sizes[key])  # else the last one runs alone
        done = in_threads(self.blobs.threads, one, largest_first)
        return {key for key, verified in done.items() if verified}

    def _verify(self, sizes: Mapping[str, int], sources: Mapping[str, Path]) -> None:
        """Every object is what its name says, or is brought once more."""
        wrong = self.retry(lambda: self.blobs.wrong(sizes)) if sizes else set[str]()
        if not wrong:
            return
        again = {key: sizes[key] for key in wrong}
        verified = self._upload(again, sources, lambda _: None)
        left = {key: size for key, size in again.items() if key not in verified}
        if left and self.retry(lambda: self.blobs.wrong(left)):
            text = f"{self.describe()} twice did not keep the bytes that were sent; nothing was published"
            raise HashError(f"{text}: check its disk and the network")

    def _switch(
        self, manifest: Manifest, before: Snapshot | None, sizes: Mapping[str, int], sources: Mapping[str, Path]
    ) -> str:
        replaced = sorted(before.manifest.keys - manifest.keys) if before else []
        data = replace(manifest, replaced=tuple(replaced)).to_json()
        tries = 0

        def swap() -> str:
            nonlocal tries
            tries += 1
            token = self.blobs.swap(data, before.token if before else None, sizes)
            if token is not None:
                return token
            found = self.blobs.manifest() if tries > 1 else None
            if found and found[0] == data:
                return found[1]  # an earlier try had worked, only its answer was lost
            raise ConflictError(self.describe())

        token = self.retry(swap)
        if before is None:  # then nobody had a version either, to clear away after
            return token
        # A store without locks may have let another push clear an object away that this one found there.
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


class _Sent:
    """Counts the bytes of one object, each once, however often it is sent."""

    def __init__(self, progress: Advance):
        self._progress, self._most, self._now = progress, 0, 0

    def again(self) -> Advance:
        self._now = 0
        return self._advance

    def _advance(self, count: int) -> None:
        self._now += count
        if self._now > self._most:
            self._progress(self._now - self._most)
            self._most = self._now


def in_threads[K, R](threads: int, work: Callable[[K], R], keys: Iterable[K]) -> dict[K, R]:
    """`work` of every key; the first error ends all, and is raised when what runs already has ended.

    Ctrl-C waits for nothing: a large file may take minutes yet.
    """
    stop, is_cut = threading.Event(), False

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
        is_cut = isinstance(error, KeyboardInterrupt)
        raise
    finally:
        pool.shutdown(wait=not is_cut, cancel_futures=True)


def wrong_when_read(blobs: Blobs, keys: Iterable[str]) -> set[str]:
    """Those of the keys whose objects are gone, or are not what their name says when all of them is read back."""

    def one(key: str) -> bool:
        digest = _Digest()
        try:
            blobs.fetch(key, cast("BinaryIO", digest), 0)
        except NotFoundError:
            return True
        return digest.sha256.hexdigest() != key

    return {key for key, is_wrong in in_threads(blobs.threads, one, keys).items() if is_wrong}


class _Digest:
    def __init__(self) -> None:
        self.sha256 = hashlib.sha256()

    def write(self, data: bytes) -> None:
        self.sha256.update(data)


def _is_usable(stored: Stored | None, size: int, is_known: bool) -> bool:
    return stored is not None and stored.size == size and (is_known or stored.age < FRESH)


def _with_sha256(manifest: Manifest) -> Manifest:
    for entry in manifest.files:
        if not entry.sha256:
            raise ManifestError(f"{entry.path!r:.200} has no sha256")
    return manifest
