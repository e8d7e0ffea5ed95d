"""Errors of remotes, whose text never holds a secret, and when to try again: retries and a least speed."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from manip_il.errors import ManipError

if TYPE_CHECKING:
    import numpy as np

HIDDEN = "[hidden]"
_SECRET_VARIABLES = (
    *("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "FSSPEC_S3_KEY", "FSSPEC_S3_SECRET"),
    *("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN"),
)
_PATTERNS = (
    (re.compile(r"\bhf_[A-Za-z0-9]{8,}"), HIDDEN),
    (re.compile(r"\b(?:AKIA|ASIA)[A-Z0-9]{12,}"), HIDDEN),
    (re.compile(r"(\w://[^/\s:@]*):\S*@"), rf"\1:{HIDDEN}@"),
    (
        re.compile(r"(?i)(x-amz-(?:signature|credential|security-token)|awsaccesskeyid|signature)=[^&\s'\"]+"),
        r"\1=" + HIDDEN,
    ),
    (re.compile(r"(?i)(authorization['\"]?\s*[:=]\s*['\"]?)(?:bearer |basic |aws4[\w-]* )?[^\s'\"]+"), r"\1" + HIDDEN),
)
_PART = 4  # characters of a secret that no text may show
_SHORTEST = 6  # characters of a secret that is hidden in every text: shorter ones may be ordinary words
LEAST_SPEED = 1000  # [bytes/s]; a modem of 1990 has twice that
WINDOW = 60.0  # of waiting, over which the speed is the mean [s]


class RemoteError(ManipError):
    """Failure of a remote; the text is cleaned of secrets on construction."""

    def __init__(self, message: str):
        super().__init__(redact(message))


class ConflictError(RemoteError):
    """Change of the remote by another push in the meantime: nothing of this push is visible."""

    def __init__(self, place: str):
        super().__init__(
            f"{place} was changed by another push in the meantime; nothing of this push is visible there; push again"
        )


class AuthError(RemoteError):
    """Missing login, or a login without the permission."""


class NotFoundError(RemoteError):
    """Missing repo, bucket, folder, host, revision or file."""


class NoSpaceError(RemoteError):
    """Full disk, on this machine or on the remote."""


class HashError(RemoteError):
    """Bytes that differ from the manifest's."""


class ManifestError(RemoteError):
    """Manifest that a pull refuses, or folder that a push refuses."""


class TransientError(RemoteError):
    """Failure that may pass: a cut connection, a 500, a 429. after: wait that the server asked for [s]."""

    def __init__(self, message: str, after: float | None = None):
        super().__init__(message)
        self.after = after


def mask(text: str, secret: str) -> str:
    """Hide a secret in `text`, and every part of it of four characters or more, also as `repr` spells it."""
    spellings = {secret, " ".join(secret.split()), repr(secret)[1:-1]}
    parts = {one[start : start + _PART] for one in spellings for start in range(max(1, len(one) - _PART + 1))} - {""}
    if len(secret) < _PART:
        return text  # a word of any text
    hidden = bytearray(len(text))
    for part in parts:
        at = text.find(part)
        while at >= 0:
            hidden[at : at + len(part)] = b"\1" * len(part)
            at = text.find(part, at + 1)
    shown = "".join("\0" if is_hidden else letter for letter, is_hidden in zip(text, hidden, strict=True))
    return re.sub("\0+", HIDDEN, shown)


def redact(text: str, *secrets: str) -> str:
    """Hide in `text` what looks like a secret, the secrets of the environment, and `secrets`."""
    known = {*secrets, *(os.environ.get(name, "") for name in _SECRET_VARIABLES)}
    for secret in sorted(known, key=len, reverse=True):
        if len(secret) >= _SHORTEST or (secret and secret in secrets):
            text = text.replace(secret, HIDDEN)
    for pattern, instead in _PATTERNS:
        text = pattern.sub(instead, text)
    return text


def _new_rng() -> np.random.Generator:
    import numpy as np  # here: every error message of a command imports this module

    return np.random.default_rng()


@dataclass(frozen=True)
class Retry:
    """Exponential back-off with full jitter (Brooker 2015, "Exponential Backoff And Jitter"), on `TransientError`.

    tries: in all. first, longest: upper bounds of the first and of any wait [s]. patience: longest wait that a server
    may ask for [s].
    """

    tries: int = 6
    first: float = 0.5
    longest: float = 20.0
    patience: float = 120.0
    sleep: Callable[[float], None] = time.sleep
    rng: np.random.Generator = field(default_factory=_new_rng)

    def __call__[T](self, work: Callable[[], T]) -> T:
        """Return what `work` returns; raise `RemoteError` with the last reason if every try fails."""
        number = 0
        while True:
            number += 1
            try:
                return work()
            except TransientError as error:
                if number == self.tries:
                    text = f"{error}; tried {number} times, try again later: what has been transferred is kept"
                    raise RemoteError(text) from None
                self.sleep(self._wait(number, error))

    def _wait(self, number: int, error: TransientError) -> float:
        """Wait after the `number`-th try [s]: what the server asked for and a little more, or a drawn one."""
        drawn = float(self.rng.uniform(0, min(self.longest, self.first * 2 ** (number - 1))))
        if error.after is None:
            return drawn
        if error.after > self.patience:
            raise RemoteError(f"{error}; the server asks to wait {error.after:.0f} s: try again then") from None
        return error.after + min(drawn, 1.0)


def retry_after(value: str | None) -> float | None:
    """Return the wait of a Retry-After header, given as a number or a date [s]; None where it holds neither."""
    if value is None:
        return None
    if value.strip().isdecimal():
        return float(value)
    from email.utils import parsedate_to_datetime

    try:
        return max(0.0, parsedate_to_datetime(value).timestamp() - time.time())
    except ValueError:
        return None


class Pace:
    """Least speed of one connection: a server that sends a byte now and then cannot hold the program for ever.

    name: of the server, for messages.
    """

    def __init__(self, name: str):
        self._name = name
        self._seconds, self._bytes = 0.0, 0

    def add(self, seconds: float, count: int) -> None:
        """Count one wait. Raises `RemoteError` if too few bytes moved in a window of waiting."""
        self._seconds, self._bytes = self._seconds + seconds, self._bytes + count
        if self._seconds < WINDOW:
            return
        if self._bytes < LEAST_SPEED * self._seconds:
            raise RemoteError(
                f"{self._name} moved {self._bytes:,} bytes in {self._seconds:.0f} s, expected at least {LEAST_SPEED:,} "
                "bytes a second; try again later, or over another connection: what has been transferred is kept"
            )
        self._seconds, self._bytes = 0.0, 0
