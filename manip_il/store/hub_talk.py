"""Talking to a Hub by huggingface_hub: with time limits, without its noise, and with errors of ours."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import threading
from collections.abc import Iterator

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
from huggingface_hub.utils import (
    are_progress_bars_disabled,
    disable_progress_bars,
    enable_progress_bars,
    get_token,
)
from huggingface_hub.utils import (
    logging as hub_logging,
)

from manip_il.errors import ManipError
from manip_il.store.errors import (
    AuthError,
    ConflictError,
    NoSpaceError,
    NotFoundError,
    RemoteError,
    TransientError,
    redact,
)
from manip_il.store.hub_client import guarded
from manip_il.store.retry import retry_after

HF = "https://huggingface.co"
LOGIN = "run `hf auth login`, or set HF_TOKEN"
_TEMPORARY = (408, 429, 500, 502, 503, 504)
_one_at_a_time = threading.Lock()
_talks: list[str] = []  # endpoints talked to now, one for each `quiet`
_found: list[tuple[bool, int, bool]] = []  # bars, verbosity and no xet, as they were before the first of them
# What huggingface_hub raises over an answer of the wrong shape: it checks none.
_NONSENSE = (TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RecursionError)
_FULL = (402, 507)  # payment required, insufficient storage
_QUOTA = re.compile(
    r"(?i)\b(?:storage|quota|space)\b"
)  # of the Hub's own words, where it answers 403 to a full account


@contextlib.contextmanager
def talking(place: str, endpoint: str, *, listing: bool = False) -> Iterator[None]:
    """What goes wrong inside is one of our errors, about `place`; the limits of `hub_client` hold inside."""
    noisy = logging.getLogger("httpx")  # it tells every URL, signatures included, wherever INFO is on
    if noisy.getEffectiveLevel() < logging.WARNING:
        noisy.setLevel(logging.WARNING)
    try:
        with guarded(endpoint, listing=listing):
            yield
    except ManipError:
        raise
    except Exception as error:
        known = explained(error, place, endpoint)
        if known is None:
            raise
        raise known from None  # its text may hold the signature of an upload


@contextlib.contextmanager
def quiet(endpoint: str) -> Iterator[None]:
    """No progress bars and warnings of huggingface_hub, and no xet where only the public Hub is known to have it.

    Its warnings name URLs, those of uploads with their signatures. All of it is the process's, so threads that talk
    at once share it: what was found comes back when the last one is done.
    """
    with _one_at_a_time:
        if not _talks:
            _found.append((not are_progress_bars_disabled(), hub_logging.get_verbosity(), constants.HF_HUB_DISABLE_XET))
            disable_progress_bars()
            hub_logging.set_verbosity_error()
        _talks.append(endpoint)
        constants.HF_HUB_DISABLE_XET |= endpoint != HF
    try:
        yield
    finally:
        with _one_at_a_time:
            _talks.remove(endpoint)
            if not _talks:
                shown, level, constants.HF_HUB_DISABLE_XET = _found.pop()
                hub_logging.set_verbosity(level)
                if shown:
                    enable_progress_bars()


def explained(error: BaseException, place: str, endpoint: str) -> RemoteError | None:
    """Return the error in our words; None for one that is no remote's."""
    cause = _cause(error)
    if isinstance(cause, RemoteError):
        return cause
    if isinstance(cause, HfHubHTTPError):
        return _answered(cause, place, endpoint)
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
    """Return the endpoint without the name and password that it may hold."""
    return httpx.URL(endpoint).copy_with(userinfo=b"").__str__().rstrip("/")


def _answered(error: HfHubHTTPError, place: str, endpoint: str) -> RemoteError:
    status, said = error.response.status_code, _said(error.response)
    if status in _TEMPORARY:
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


def _said(response: httpx.Response) -> str:
    """The server's own words, one line of them, without the token."""
    text = " ".join(response.headers.get("X-Error-Message", "").split())[:200]
    return f" ({redact(text, get_token() or '')})" if text else ""


def _cause(error: BaseException) -> BaseException:
    """What huggingface_hub wrapped in a RuntimeError of its upload threads."""
    while isinstance(error, RuntimeError) and error.__cause__ is not None:
        error = error.__cause__
    return error
