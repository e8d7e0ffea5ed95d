"""What can go wrong with a remote; no message ever holds a token, a key or a password."""

from __future__ import annotations

import os
import re

from manip_il.errors import ManipError

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
_PART = 4  # characters of a secret that are too many to be seen
_SHORTEST = 6  # characters of a secret that is hidden wherever it stands: shorter ones are words of any text


class RemoteError(ManipError):
    """A remote that cannot do what was asked; the text is cleaned of secrets on construction."""

    def __init__(self, message: str):
        super().__init__(redact(message))


class ConflictError(RemoteError):
    """Somebody else changed the remote meanwhile: this push did not happen."""

    def __init__(self, place: str):
        super().__init__(
            f"{place} was changed by another push in the meantime; nothing of this push is visible there; push again"
        )


class AuthError(RemoteError):
    """Nobody is logged in, or who is may not do this."""


class NotFoundError(RemoteError):
    """No such repo, bucket, folder, host, revision or file."""


class NoSpaceError(RemoteError):
    """A disk, here or there, is full."""


class HashError(RemoteError):
    """Bytes that are not those of the manifest."""


class ManifestError(RemoteError):
    """A manifest, or a folder to make one of, that no push makes and no pull takes."""


class TransientError(RemoteError):
    """What may work a moment later: a cut connection, a 500, a 429. after: what the server asked to wait [s]."""

    def __init__(self, message: str, after: float | None = None):
        super().__init__(message)
        self.after = after


def mask(text: str, secret: str) -> str:
    """`text` without the secret and without any part of it of four characters or more, spelled as `repr` does too."""
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
    """`text` without what looks like a secret, without those in the environment, and without `secrets`."""
    known = {*secrets, *(os.environ.get(name, "") for name in _SECRET_VARIABLES)}
    for secret in sorted(known, key=len, reverse=True):
        if len(secret) >= _SHORTEST or (secret and secret in secrets):
            text = text.replace(secret, HIDDEN)
    for pattern, instead in _PATTERNS:
        text = pattern.sub(instead, text)
    return text
