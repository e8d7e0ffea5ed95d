"""What a store of plain files must do for a dataset or policy to lie on it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from manip_il.store.remote import Advance

OBJECTS = "objects"  # folder of the objects
STALE = 24 * 3600.0  # what no version names is removed from this age on: an unfinished push is never robbed [s]


@dataclass(frozen=True)
class Stored:
    """An object on the store. age: since it was written, by the store's clock [s]."""

    size: int
    age: float


class Blobs(Protocol):
    """The store beneath. Methods raise errors of `errors`, `TransientError` where another try may help.

    Objects are known by the sha256 of their bytes, their key. There is one manifest; its token is opaque, and another
    one where the content is another.
    """

    threads: int  # that may use it at a time
    warnings: tuple[str, ...]

    def describe(self) -> str:
        """Return the place, for messages."""
        ...

    def manifest(self) -> tuple[bytes, str] | None:
        """Return content and token; None where there is none."""
        ...

    def prepare(self, size: int) -> None:
        """Called before so many bytes are uploaded: refuse a place that holds something else, or too little space."""
        ...

    def swap(self, data: bytes, before: str | None, needed: Mapping[str, int]) -> str | None:
        """Replace the manifest in one step where its token is still `before`, and return the new one; else None.

        needed: keys and sizes of the objects that must be there.
        """
        ...

    def fetch(self, key: str, target: BinaryIO, offset: int) -> None:
        """Write an object's bytes from `offset` on to `target`. Raises `NotFoundError` where it is gone."""
        ...

    def put(self, key: str, source: Path, size: int, advance: Advance) -> bool:
        """Have the object there, whole or not at all; return whether it was verified."""
        ...

    def find(self, keys: Iterable[str]) -> dict[str, Stored]:
        """Those of `keys` that are there."""
        ...

    def list(self) -> dict[str, Stored]:
        """Return every object."""
        ...

    def wrong(self, sizes: Mapping[str, int]) -> set[str]:
        """Those of the keys whose objects are missing or are not what their name says."""
        ...

    def remove(self, keys: Iterable[str], token: str) -> None:
        """Remove objects, and what killed pushes left, unless the manifest's token is no longer `token`."""
        ...
