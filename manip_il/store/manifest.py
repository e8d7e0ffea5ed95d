"""The list of files of a dataset or policy, with sizes and hashes: what one version of it is.

It comes from outside, so it refuses itself on construction where it names anything but plain files inside a folder.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, cast

from manip_il.store.errors import ManifestError
from manip_il.store.paths import check_path, check_together

VERSION = 1
MOST_FILES = 200_000
LARGEST = 10**12  # of all files together, unless the caller says otherwise [bytes]
LONGEST_TEXT = 2**26  # of a manifest [bytes]
_KINDS = ("dataset", "policy")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_SHA1 = re.compile(r"[0-9a-f]{40}")

Kind = Literal["dataset", "policy"]


@dataclass(frozen=True)
class FileEntry:
    """One file. path: relative, with `/`. size [bytes]. git_sha1: git's blob id, where a Hub knows no sha256."""

    path: str
    size: int
    sha256: str = ""
    git_sha1: str = ""

    def __post_init__(self) -> None:
        """Raise `ManifestError` for a path that leaves the folder or names code, a size or a hash that is none."""
        check_path(self.path)
        if type(self.size) is not int or self.size < 0:
            raise ManifestError(f"{self.path!r:.200} has size {self.size!r:.40}; expected a number of bytes")
        _check_hash(self.path, "sha256", self.sha256, _SHA256)
        _check_hash(self.path, "git_sha1", self.git_sha1, _SHA1)
        if not self.sha256 and not self.git_sha1:
            raise ManifestError(f"{self.path!r:.200} has no hash; it could not be verified")

    @property
    def key(self) -> str:
        """What its bytes are known by."""
        return self.sha256 or f"git-{self.git_sha1}"


@dataclass(frozen=True)
class Manifest:
    """All files of one version, sorted by path.

    replaced: hashes that only the version before names; a store removes them with the next push. largest: more bytes
    in all are refused.
    """

    kind: Kind
    files: tuple[FileEntry, ...]
    version: int = VERSION
    replaced: tuple[str, ...] = ()
    largest: int = LARGEST

    def __post_init__(self) -> None:
        """Raise `ManifestError` for anything that no push of ours writes."""
        if self.version != VERSION or type(self.version) is not int:
            text = f"the manifest has version {self.version!r:.40}, this program reads {VERSION}; use a newer manip-il"
            raise ManifestError(text)
        if self.kind not in _KINDS:
            raise ManifestError(f"the manifest is of a {self.kind!r:.40}; expected dataset or policy")
        if len(self.files) > MOST_FILES:
            raise ManifestError(f"the manifest names {len(self.files):,} files; at most {MOST_FILES:,} are accepted")
        object.__setattr__(self, "files", tuple(sorted(self.files, key=lambda entry: entry.path)))
        check_together([entry.path for entry in self.files])
        if self.size > self.largest:
            text = f"the manifest names {self.size:,} bytes; at most {self.largest:,} are accepted"
            raise ManifestError(text)
        for sha256 in self.replaced:
            _check_hash("replaced", "sha256", sha256, _SHA256)

    @cached_property
    def size(self) -> int:
        """Of all files together [bytes]."""
        return sum(entry.size for entry in self.files)

    @cached_property
    def by_path(self) -> Mapping[str, FileEntry]:
        """The entries by path."""
        return {entry.path: entry for entry in self.files}

    @cached_property
    def keys(self) -> frozenset[str]:
        """What the files' bytes are known by."""
        return frozenset(entry.key for entry in self.files)

    def to_json(self) -> bytes:
        """As it is kept beside the files."""
        files = [_plain(entry) for entry in self.files]
        replaced = {"replaced": list(self.replaced)} if self.replaced else {}
        return json.dumps({"version": self.version, "kind": self.kind, "files": files, **replaced}, indent=1).encode()

    @classmethod
    def from_json(cls, data: bytes, largest: int = LARGEST) -> Manifest:
        """Raises `ManifestError` for anything that `to_json` does not write."""
        if len(data) > LONGEST_TEXT:
            raise ManifestError(f"the manifest is {len(data):,} bytes long; at most {LONGEST_TEXT:,} are read")
        try:
            tree = json.loads(data, object_pairs_hook=_no_twins, parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            raise ManifestError(f"the manifest is not valid JSON: {str(error)[:200]}") from None
        table = _object(tree, "the manifest", {"version", "kind", "files"}, {"replaced"})
        files = _list(table["files"], "files", MOST_FILES)
        replaced = _list(table.get("replaced", []), "replaced", MOST_FILES)
        return cls(table["kind"], tuple(map(_entry, files)), table["version"], tuple(replaced), largest)


def _entry(value: Any) -> FileEntry:
    table = _object(value, "a file of the manifest", {"path", "size"}, {"sha256", "git_sha1"})
    return FileEntry(**table)


def _plain(entry: FileEntry) -> dict[str, Any]:
    hashes = {"sha256": entry.sha256, "git_sha1": entry.git_sha1}
    return {"path": entry.path, "size": entry.size, **{name: value for name, value in hashes.items() if value}}


def _object(value: Any, what: str, needed: set[str], allowed: set[str]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ManifestError(f"{what} is {type(value).__name__}; expected an object")
    table = cast("dict[str, Any]", value)
    if not needed <= table.keys() <= needed | allowed:
        raise ManifestError(f"{what} has the keys {', '.join(table)[:200]!r}; expected {', '.join(sorted(needed))}")
    return table


def _list(value: Any, what: str, most: int) -> list[Any]:
    if not isinstance(value, list):
        raise ManifestError(f"{what} of the manifest is {type(value).__name__}; expected a list")
    if len(value) > most:
        raise ManifestError(f"the manifest names {len(value):,} files; at most {most:,} are accepted")
    return value


def _check_hash(path: str, what: str, value: object, pattern: re.Pattern[str]) -> None:
    if not isinstance(value, str) or (value and not pattern.fullmatch(value)):
        raise ManifestError(f"{path!r:.200} has {what} {value!r:.80}; expected hexadecimal digits")


def _no_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) != len(pairs):
        raise ValueError("a key appears twice")
    return table


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not a number")
