"""Sessions with a Hub through huggingface_hub: with limits, without its messages, and with its errors in our words."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import threading
from collections.abc import Generator

import httpx
from huggingface_hub import constants
from huggingface_hub.errors import (
    EntryNotFoundError,
    HfHubHTTPError,
    HFValidationError,
    LocalTokenNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars, get_token
from huggingface_hub.utils import logging as hub_logging

from manip_il.errors import ManipError
from manip_il.store.errors import (
    AuthError,
    ConflictError,
    NoSpaceError,
    NotFoundError,
    RemoteError,
    TransientError,
    redact,
    retry_after,
)
from manip_il.store.hub_http import TEMPORARY, limited

HF = "https://huggingface.co"
LOGIN = "run `hf auth login`, or set HF_TOKEN"
# What huggingface_hub raises over an answer of the wrong shape: it checks none.
_NONSENSE = (TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RecursionError)
_FULL = (402, 507)  # payment required, insufficient storage
_QUOTA = re.compile(r"(?i)\b(?:storage|quota|space)\b")  # in a Hub's message, if it answers 403 to a full account
_lock = threading.Lock()
_endpoints: list[str] = []  # of the sessions that are open now
_saved: list[tuple[bool, int, bool]] = []  # bars, verbosity and no xet, as they were before the first of them


@contextlib.contextmanager
def hub_session(place: str, endpoint: str, *, listing: bool = False) -> Generator[None]:
    """Apply the limits of `hub_http` inside, silence huggingface_hub, and raise its errors as ours, about `place`.

    listing: the answer comes in pages.
    """
    noisy = logging.getLogger("httpx")  # it logs every URL, with signatures, at level INFO
    if noisy.getEffectiveLevel() < logging.WARNING:
        noisy.setLevel(logging.WARNING)
    try:
        with _silenced(endpoint), limited(endpoint, listing=listing):
            yield
    except ManipError:
        raise
    except Exception as error:
        ours = translate(error, place, endpoint)
        if ours is None:
            raise
        raise ours from None  # its text may hold the signature of an upload


@contextlib.contextmanager
def _silenced(endpoint: str) -> Generator[None]:
    """Switch off progress bars and warnings of huggingface_hub, and xet unless it is the public Hub, which has it.

    Its warnings contain URLs, those of uploads with their signatures. The settings are the process's, so threads share
    them: the last one to leave restores them.
    """
    with _lock:
        if not _endpoints:
            _saved.append((not are_progress_bars_disabled(), hub_logging.get_verbosity(), constants.HF_HUB_DISABLE_XET))
            disable_progress_bars()
            hub_logging.set_verbosity_error()
        _endpoints.append(endpoint)
        constants.HF_HUB_DISABLE_XET |= endpoint != HF
    try:
        yield
    finally:
        with _lock:
            _endpoints.remove(endpoint)
            if not _endpoints:
                has_bars, level, constants.HF_HUB_DISABLE_XET = _saved.pop()
                hub_logging.set_verbosity(level)
                if has_bars:
                    enable_progress_bars()


def translate(error: BaseException, place: str, endpoint: str) -> RemoteError | None:
    """Return an error in our words; None for one that is not a remote's."""
    cause = error
    while isinstance(cause, RuntimeError) and cause.__cause__ is not None:
        cause = cause.__cause__  # huggingface_hub's upload threads wrap errors
    if isinstance(cause, RemoteError):
        return cause
    if isinstance(cause, HfHubHTTPError):
        return _translate_answer(cause, place, endpoint)
    if isinstance(cause, OfflineModeIsEnabled):
        return RemoteError(f"{place} cannot be reached: HF_HUB_OFFLINE is set; unset it")
    if isinstance(cause, LocalTokenNotFoundError):
        return AuthError(f"{place}: not logged in at {host(endpoint)}; {LOGIN}")
    if isinstance(cause, HFValidationError):
        return NotFoundError(f"{place} is not a valid name on a Hub; expected USER/NAME of letters, digits, - _ .")
    if isinstance(cause, httpx.ConnectError):
        return TransientError(f"{place} cannot be reached: nothing answers at {host(endpoint)}; is HF_ENDPOINT right?")
    if isinstance(cause, httpx.TimeoutException):
        return TransientError(f"{place}: {host(endpoint)} gave no answer in time")
    if isinstance(cause, httpx.TransportError):
        return TransientError(f"{place}: the connection to {host(endpoint)} was cut")
    if isinstance(cause, json.JSONDecodeError):
        return TransientError(f"{place}: {host(endpoint)} answered something that is not JSON; is it a Hub?")
    if isinstance(cause, (httpx.HTTPError, httpx.InvalidURL, *_NONSENSE)):
        return RemoteError(
            f"{place}: {host(endpoint)} gave an answer that is not a Hub's ({type(cause).__name__}); is it a Hub?"
        )
    return None


def host(endpoint: str) -> str:
    """Return the endpoint without a name and password."""
    return httpx.URL(endpoint).copy_with(userinfo=b"").__str__().rstrip("/")


def _translate_answer(error: HfHubHTTPError, place: str, endpoint: str) -> RemoteError:
    status, said = error.response.status_code, _message(error.response)
    if status in TEMPORARY:
        after = retry_after(error.response.headers.get("Retry-After"))
        return TransientError(f"{place}: {host(endpoint)} answered {status}{said}", after)
    if isinstance(error, RevisionNotFoundError):
        return NotFoundError(f"{place}: no such revision{said}")
    if isinstance(error, EntryNotFoundError):
        return NotFoundError(f"{place}: no such file{said}")
    if isinstance(error, RepositoryNotFoundError):
        return NotFoundError(f"{place} is not at {host(endpoint)}, or is private: check the name, or {LOGIN}")
    if status == 413:
        text = f"{place}: that Hub does not accept files this large{said}"
        return NoSpaceError(f"{text}; ask who runs it for a higher limit, or push in parts")
    if status in _FULL or (status == 403 and _QUOTA.search(said)):
        text = f"{place}: that Hub has no space left for this account{said}"
        return NoSpaceError(
            f"{text}; delete old files there or get more space, and push again: what has been transferred is kept"
        )
    if status == 401:
        wrong = f"the token is refused{said}" if get_token() else "not logged in"
        return AuthError(f"{place}: {wrong}; {LOGIN}, with a token from {host(endpoint)}/settings/tokens")
    if status == 403:
        text = f"{place}: this token may not do that{said}"
        return AuthError(f"{text}; create one with write permission at {host(endpoint)}/settings/tokens")
    if status in (409, 412):
        return ConflictError(place)
    return RemoteError(f"{place}: {host(endpoint)} answered {status}{said}")


def _message(response: httpx.Response) -> str:
    """Return the server's own message in one line, without the token."""
    text = " ".join(response.headers.get("X-Error-Message", "").split())[:200]
    return f" ({redact(text, get_token() or '')})" if text else ""
