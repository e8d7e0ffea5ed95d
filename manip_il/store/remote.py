"""Remotes: URLs such as `s3://bucket/demos`, and what every remote can do."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote

from manip_il.errors import UnknownName, UsageError
from manip_il.store.manifest import FileEntry, Kind, Manifest

MANIFEST_FILE = "manip_il_manifest.json"
FORMS = {  # scheme -> how it is written
    "hf": "hf://datasets/USER/NAME[@REVISION] or hf://USER/NAME[@REVISION]",
    "s3": "s3://BUCKET/FOLDER",
    "sftp": "sftp://[USER@]HOST[:PORT]/FOLDER",
    "file": "file://FOLDER",
}
_HUB_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9_])?")
_REVISION = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._/-]{0,254}")
_BUCKET = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{1,253}")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]{0,15}")
_LIKE_AN_ADDRESS = re.compile(r"://|:.*@|@.*:|^(?:hf|s3|sftp|file|ssh|scp|ftps?|https?):", re.DOTALL | re.IGNORECASE)
_SFTP = re.compile(
    r"(?:(?P<user>[^:@/]+)(?::(?P<password>[^@]*))?@)?(?P<host>\[[0-9a-fA-F:.]+\]|[^:@/\[\]]+)(?::(?P<port>\d+))?"
)

Advance = Callable[[int], None]  # so many bytes more are done
Intake = Callable[[Path], tuple[int, str]]  # a file -> its size [bytes] and sha256
Progress = Callable[[int, str], AbstractContextManager[Advance]]  # total [bytes] and what it is of


class Sink(Protocol):
    """Receiver of a file's bytes."""

    def write(self, data: bytes | memoryview, /) -> object:
        """Take the next bytes; the caller may use their memory again when the next call has returned."""
        ...


@dataclass(frozen=True)
class Snapshot:
    """One version, as readers see it. token: opaque; another version has another one."""

    manifest: Manifest
    token: str


@dataclass(frozen=True)
class Published:
    """Result of a push. uploaded, kept, removed: files; size: of the uploaded ones [bytes]."""

    uploaded: int
    size: int
    kept: int
    removed: int
    token: str = ""


class Remote(Protocol):
    """One dataset or policy on another disk.

    Methods raise errors of `manip_il.store.errors`, after the tries that may help.
    """

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about this store for the user, as far as they are known by now."""
        ...

    @property
    def threads(self) -> int:
        """Largest number of threads that may fetch at the same time."""
        ...

    @property
    def name(self) -> str:
        """Name of the place for messages, without any secret."""
        ...

    def read(self) -> Snapshot | None:
        """Return the version that readers see now; None if nothing is there yet."""
        ...

    def fetch(self, snapshot: Snapshot, entry: FileEntry, target: Sink, offset: int) -> None:
        """Write the bytes of one file from `offset` on to `target`, in one try.

        Raises `NotFoundError` if the file is gone: readers see another version by now. Several threads call it at once.
        """
        ...

    def intake(self, before: Snapshot | None, size: int) -> Intake | None:
        """Return what copies a file to the remote and hashes it in the same pass, before `publish` names it.

        None where a file's hash must be known first, as the remote may have it already. size: of all files [bytes].
        """
        ...

    def publish(
        self, local: Mapping[str, Path], manifest: Manifest, before: Snapshot | None, progress: Advance
    ) -> Published:
        """Upload what `before` lacks, then switch readers over in one step.

        local: the manifest's files by their paths. progress: gets every byte of a file that `before` lacks, also of one
        that an earlier try had uploaded. Raises `ConflictError` if the remote is no longer `before`; readers then see
        what they saw.
        """
        ...


@dataclass(frozen=True)
class RemoteUrl:
    """Parsed URL, printed without its password.

    kind: of what is there, if the URL says it. place: `USER/NAME`, `BUCKET/FOLDER`, a folder. revision: on the Hub.
    """

    scheme: str
    place: str
    kind: Kind | None = None
    revision: str | None = None
    host: str = ""
    port: int | None = None
    user: str | None = None
    password: str | None = field(default=None, repr=False)

    @classmethod
    def parse(cls, text: str) -> RemoteUrl:
        """Parse a URL. Raises `UsageError` for an unknown scheme and for anything not written as in `FORMS`."""
        scheme, colon, rest = text.partition("://")
        if not colon:
            raise UsageError(f"{_shown(text)!r} is not a URL; expected one of {'; '.join(FORMS.values())}")
        if scheme not in FORMS:
            shown = f"{scheme}://" if _SCHEME.fullmatch(scheme) else "..."
            raise UnknownName("scheme", shown, [f"{known}://" for known in FORMS])
        if not rest or any(ord(letter) < 32 or ord(letter) == 127 for letter in rest):
            raise _wrong(scheme, text)
        return _PARSERS[scheme](text, rest)

    def __str__(self) -> str:
        """Return the URL as it was written, without the password."""
        if self.scheme == "hf":
            kind = "datasets/" if self.kind == "dataset" else ""
            return f"hf://{kind}{self.place}" + (f"@{self.revision}" if self.revision else "")
        if self.scheme != "sftp":
            return f"{self.scheme}://{self.place}"
        user, port = f"{self.user}@" if self.user else "", f":{self.port}" if self.port else ""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"sftp://{user}{host}{port}{self.place}"


def secrets_in(word: str) -> list[str]:
    """Return what may be a secret in a word of a command line: the password of a URL.

    In a URL that cannot be parsed, that is everything behind the first colon, or before the last @.
    """
    text = word.partition("=")[2] if word.startswith("-") and "=" in word.partition("://")[0] else word.lstrip("-")
    if not _LIKE_AN_ADDRESS.search(text):
        return []
    try:
        password = RemoteUrl.parse(text).password
        written = text.partition("://")[2].partition("@")[0].partition(":")[2]
        return [password, written] if password else []
    except UsageError:
        scheme, mark, rest = text.partition("://")
        rest = rest if mark and _SCHEME.fullmatch(scheme) else text
        return [rest.partition(":")[2] if ":" in rest else rest.rpartition("@")[0]]


def _hub(text: str, rest: str) -> RemoteUrl:
    place, at, revision = rest.partition("@")
    parts = place.split("/")
    kind: Kind = "policy"
    if len(parts) == 3 and parts[0] in ("datasets", "models"):
        kind = "dataset" if parts.pop(0) == "datasets" else "policy"
    is_name = len(parts) == 2 and all(_HUB_NAME.fullmatch(part) and ".." not in part for part in parts)
    is_name = is_name and parts[0] not in ("datasets", "models", "spaces")  # the user is missing
    if not is_name or (at and (not _REVISION.fullmatch(revision) or ".." in revision or "//" in revision)):
        raise _wrong("hf", text)
    return RemoteUrl("hf", "/".join(parts), kind, revision or None)


def _s3(text: str, rest: str) -> RemoteUrl:
    bucket, _, prefix = rest.partition("/")
    prefix = prefix.strip("/")
    if ":" in prefix.rpartition("@")[0]:  # an address of another kind, with a password
        raise _wrong("s3", text)
    if not _BUCKET.fullmatch(bucket) or any(part in ("", ".", "..") for part in prefix.split("/")):
        raise _wrong("s3", text)
    return RemoteUrl("s3", f"{bucket}/{prefix}")


def _sftp(text: str, rest: str) -> RemoteUrl:
    split = rest.find("/")
    found = _SFTP.fullmatch(rest[:split]) if split > 0 else None
    if ":" in rest.rpartition("@")[0] and rest.rfind("@") != rest.find("@", 0, split):
        found = None  # a password that holds / or @ is not told from a host and a path
    path = rest[split:].rstrip("/")
    if found is None or not path or ".." in path.split("/"):
        raise _wrong("sftp", text)
    port = int(found["port"]) if found["port"] else None
    if port is not None and not 0 < port < 65536:
        raise _wrong("sftp", text)
    password = unquote(found["password"]) if found["password"] else None
    return RemoteUrl("sftp", path, None, None, found["host"].strip("[]"), port, found["user"], password)


def _file(text: str, rest: str) -> RemoteUrl:
    place = rest.rstrip("/")
    if not place or ":" in place.rpartition("@")[0]:  # the latter is an address of another kind, with a password
        raise _wrong("file", text)
    return RemoteUrl("file", place)


_PARSERS = {"hf": _hub, "s3": _s3, "sftp": _sftp, "file": _file}


def _wrong(scheme: str, text: str) -> UsageError:
    hint = " (in a password write / as %2F, @ as %40, : as %3A)" if scheme == "sftp" else ""
    return UsageError(f"{_shown(text)!r} cannot be read; expected {FORMS[scheme]}{hint}")


def _shown(text: str) -> str:
    """Return the text, or its scheme alone if the rest may hold a password."""
    scheme, mark, rest = text.partition("://")
    if mark and _SCHEME.fullmatch(scheme):
        return f"{scheme}://..." if ":" in rest or "@" in rest else text
    return "..." if ":" in text or "@" in text else text
