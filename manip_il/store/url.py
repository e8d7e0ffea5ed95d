"""Where to push to and to pull from, as one word: `s3://bucket/demos`."""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass, field
from typing import Literal
from urllib.parse import unquote

from manip_il.errors import UnknownName, UsageError
from manip_il.store.remote import Remote

Kind = Literal["dataset", "policy"]

FORMS = {  # scheme -> how it is written
    "hf": "hf://datasets/USER/NAME[@REVISION] or hf://USER/NAME[@REVISION]",
    "s3": "s3://BUCKET/FOLDER",
    "sftp": "sftp://[USER@]HOST[:PORT]/FOLDER",
    "file": "file://FOLDER",
}
_REMOTES = {  # scheme -> what is made of the URL; imported when it is needed
    "hf": "manip_il.store.hub:HubRemote",
    "s3": "manip_il.store.s3_store:open_s3",
    "sftp": "manip_il.store.sftp_store:open_sftp",
    "file": "manip_il.store.file_store:open_file",
}
_HUB_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9_])?")
_REVISION = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._/-]{0,254}")
_BUCKET = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{1,253}")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]{0,15}")
_LIKE_AN_ADDRESS = re.compile(r"://|:.*@|@.*:|^(?:hf|s3|sftp|file|ssh|scp|ftps?|https?):", re.DOTALL | re.IGNORECASE)
_SFTP = re.compile(
    r"(?:(?P<user>[^:@/]+)(?::(?P<password>[^@]*))?@)?(?P<host>\[[0-9a-fA-F:.]+\]|[^:@/\[\]]+)(?::(?P<port>\d+))?"
)


@dataclass(frozen=True)
class RemoteUrl:
    """A parsed URL; its text never shows the password.

    kind: what lies there, as far as the URL says. place: `USER/NAME`, `BUCKET/FOLDER`, a folder. revision: of the Hub.
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
        """Raises `UsageError` for an unknown scheme and for what is not written as `FORMS` has it."""
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
        """As it was written, less the password."""
        if self.scheme == "hf":
            kind = "datasets/" if self.kind == "dataset" else ""
            return f"hf://{kind}{self.place}" + (f"@{self.revision}" if self.revision else "")
        if self.scheme != "sftp":
            return f"{self.scheme}://{self.place}"
        user, port = f"{self.user}@" if self.user else "", f":{self.port}" if self.port else ""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"sftp://{user}{host}{port}{self.place}"


def open_remote(url: RemoteUrl, *, private: bool = False) -> Remote:
    """Return the remote of a URL; nothing is asked of it yet. private: of a repo that a push would make on the Hub."""
    module, _, name = _REMOTES[url.scheme].partition(":")
    make = getattr(importlib.import_module(module), name)
    return make(url, private=private) if url.scheme == "hf" else make(url)


def _hub(text: str, rest: str) -> RemoteUrl:
    place, at, revision = rest.partition("@")
    parts = place.split("/")
    kind: Kind = "policy"
    if len(parts) == 3 and parts[0] in ("datasets", "models"):
        kind = "dataset" if parts.pop(0) == "datasets" else "policy"
    is_name = len(parts) == 2 and all(_HUB_NAME.fullmatch(part) and ".." not in part for part in parts)
    is_name = is_name and parts[0] not in ("datasets", "models", "spaces")  # the user is missing
    if not is_name or (at and not _is_revision(revision)):
        raise _wrong("hf", text)
    return RemoteUrl("hf", "/".join(parts), kind, revision or None)


def _is_revision(text: str) -> bool:
    return bool(_REVISION.fullmatch(text)) and ".." not in text and "//" not in text


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


def secrets_in(word: str) -> list[str]:
    """What may be a secret in a word of a command line: an address's password, or all that may be one.

    Where the address cannot be read, that is everything behind the first colon, or before the last @.
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


def _shown(text: str) -> str:
    """What was given, or its scheme alone where anything of the rest may be a password."""
    scheme, mark, rest = text.partition("://")
    if mark and _SCHEME.fullmatch(scheme):
        return f"{scheme}://..." if ":" in rest or "@" in rest else text
    return "..." if ":" in text or "@" in text else text
