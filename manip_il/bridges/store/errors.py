"""Errors of remotes: one line with a remedy, without tokens, keys or passwords."""

import os
import re
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from urllib.parse import unquote

from manip_il.checks import one_line
from manip_il.errors import ManipError

HIDDEN = "[hidden]"
SENT = set[str]()  # secrets that this process has sent, wherever it had them from
# [characters]: shortest secret that is hidden, longest printed message
_SHORTEST, _LONGEST = 4, 400
_SECRET_VARIABLE = re.compile(r"TOKEN$|SECRET|PASSW|ACCESS_KEY|S3_KEY")
_SECRETS = (
    re.compile(r"\b()(?:hf_[A-Za-z0-9]{8,}|(?:AKIA|ASIA)[A-Z0-9]{12,})"),
    re.compile(r"(\w://[^/\s:@]*:).*(?=@)"),
    re.compile(r"(?i)((?:signature|credential|security-token|awsaccesskeyid)=)[^&\s'\"]+"),
    re.compile(
        r"(?i)(authorization['\"]?\s*[:=]\s*['\"]?)(?:bearer |basic |aws4[\w-]* )?[^\s'\"]+"
    ),
)
_REMEDIES = {  # by HTTP status, else by the name of the error's class or nearest base class
    "401": "log in with `hf auth login`, or set HF_TOKEN",
    "403": "use a token with write access, or a repository of your own",
    "404": "check the name; if the server does not support xet, set HF_HUB_DISABLE_XET=1",
    "412": "another push has changed it in the meantime: push again",
    "ConnectError": "check HF_ENDPOINT and the network",
    "NoCredentialsError": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile in ~/.aws",
    "EndpointConnectionError": "check AWS_ENDPOINT_URL and the network",
    "SSHException": (
        "run `ssh HOST` once: its key must be in ~/.ssh/known_hosts, yours in the agent or"
        " ~/.ssh/config"
    ),
    "FileNotFoundError": "check the name",
    "PermissionError": "check your credentials, or choose another address",
    "OSError": "check the address, the network and the free space there, and try again",
}


class RemoteError(ManipError):
    """A remote failed; secrets are removed from the message."""

    def __init__(self, message: str):
        super().__init__(redact(message))


@contextmanager
def explained(what: str) -> Generator[None]:
    """Turn a library's errors into `RemoteError`.

    Args:
        what: The attempted action, with the remote's name.
    """
    try:
        yield
    except ManipError:
        raise
    except Exception as error:
        status = getattr(getattr(error, "response", None), "status_code", "")
        names = [str(status), *(base.__name__ for base in type(error).__mro__)]
        remedy = next((_REMEDIES[name] for name in names if name in _REMEDIES), "try again")
        reason = (
            one_line(error).replace(" For more information check: ", "; see ")[:_LONGEST]
            or type(error).__name__
        )
        raise RemoteError(f"cannot {what}: {reason}; {remedy}") from error


def redact(text: str, words: Iterable[str] = ()) -> str:
    """Hide what was sent, values of secret environment variables, passwords in `words`, and
    likely tokens in a text.
    """
    secrets = SENT | {value for name, value in os.environ.items() if _SECRET_VARIABLE.search(name)}
    for word in words:
        password = (word.partition("://")[2] or word).partition(":")[2].rpartition("@")[0]
        secrets |= {password, unquote(password), repr(password)[1:-1], *password.split("=")}
    for secret in sorted(secrets, key=len, reverse=True):
        if len(secret) >= _SHORTEST:
            text = text.replace(secret, HIDDEN)
    for pattern in _SECRETS:
        text = pattern.sub(rf"\1{HIDDEN}", text)
    return text
