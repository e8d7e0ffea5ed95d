"""What every place to push to and to pull from can do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from manip_il.store.manifest import FileEntry, Manifest

MANIFEST_FILE = "manip_il_manifest.json"

Advance = Callable[[int], None]  # so many bytes more are done


@dataclass(frozen=True)
class Snapshot:
    """What readers see at one moment. token: opaque; another one where anything differs."""

    manifest: Manifest
    token: str


@dataclass(frozen=True)
class Published:
    """What a push did. uploaded, kept, removed: files; size: of the uploaded ones [bytes]."""

    uploaded: int
    size: int
    kept: int
    removed: int
    token: str = ""


class Remote(Protocol):
    """One dataset or policy, somewhere else.

    Methods raise errors of `manip_il.store.errors`. What is worth another try was tried again before.
    """

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know of this store, as far as it has shown by now."""
        ...

    @property
    def threads(self) -> int:
        """That may fetch at a time."""
        ...

    def describe(self) -> str:
        """Return the place, as messages name it: without any secret."""
        ...

    def read(self) -> Snapshot | None:
        """What readers see now; None where there is nothing yet."""
        ...

    def fetch(self, snapshot: Snapshot, entry: FileEntry, target: BinaryIO, offset: int) -> None:
        """Write the bytes of one file from `offset` on to `target`, as they come.

        Raises `NotFoundError` where the file is gone: the snapshot is no longer what readers see. Called from several
        threads at once.
        """
        ...

    def publish(
        self, local: Mapping[str, Path], manifest: Manifest, before: Snapshot | None, progress: Advance
    ) -> Published:
        """Upload what `before` lacks, then switch readers over in one step.

        local: where the manifest's files lie, by their paths. progress: is told of every byte of a file that `before`
        lacks, also where an earlier try had brought it there. Raises `ConflictError` where the remote is no longer
        `before`; what it shows readers is then as it was.
        """
        ...
