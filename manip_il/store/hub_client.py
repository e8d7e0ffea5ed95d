"""The HTTP client that huggingface_hub gets from here.

Every wait has a limit, every answer an end, and the token goes to the endpoint's origin (scheme, host, port) alone.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import httpx
from huggingface_hub import set_client_factory
from huggingface_hub.utils import _http as hub_http  # pyright: ignore[reportPrivateUsage]

from manip_il.store.errors import RemoteError
from manip_il.store.pace import PacedBackend

CONNECT, PATIENCE = 20.0, 120.0  # until a connection is there, until the next byte [s]
LARGEST_ANSWER, LONGEST_ANSWER = 2**26, 600.0  # of anything but a file [bytes], [s]
MOST_PAGES, LONGEST_LISTING = 5_000, 3600.0  # of one list: requests, [s]
FILE = "manip_il.file"  # extension of a request whose answer is a file, which is measured where it is written
_TEMPORARY = (408, 429, 500, 502, 503, 504)  # after which huggingface_hub waits for as long as it is told
_RESET = re.compile(r";\s*t\s*=\s*(\d+)")  # of the `ratelimit` header [s]


@dataclass
class _Listing:
    """What is left of one list."""

    pages: int
    until: float


class _Guard:
    """The hooks of the client; they hold while somebody talks to `origin`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._talks = 0
        self._origin: httpx.URL | None = None
        self._listing: ContextVar[_Listing | None] = ContextVar("listing", default=None)

    @contextlib.contextmanager
    def talk(self, endpoint: str, *, listing: bool = False) -> Iterator[None]:
        with self._lock:
            self._talks, self._origin = self._talks + 1, httpx.URL(endpoint)
        left = _Listing(MOST_PAGES, time.monotonic() + LONGEST_LISTING) if listing else None
        before = self._listing.set(left)
        try:
            yield
        finally:
            self._listing.reset(before)
            with self._lock:
                self._talks -= 1

    def before(self, request: httpx.Request) -> None:
        """Hook of a request, of a redirected one too."""
        if not self._talks:
            return
        if self._origin is None or not _same_origin(request.url, self._origin):
            request.headers.pop("Authorization", None)
        request.headers["Accept-Encoding"] = "identity"  # a size is a size then
        if (listing := self._listing.get()) is not None:
            listing.pages -= 1
            if listing.pages < 0 or time.monotonic() > listing.until:
                text = f"more than {MOST_PAGES:,} pages" if listing.pages < 0 else f"more than {LONGEST_LISTING:.0f} s"
                raise RemoteError(f"{_name(request.url)} has a list of {text}; is it a Hub?")
        given = request.extensions.get("timeout") or {}
        if all(value is None for value in given.values()):
            limits = {"connect": CONNECT, "read": PATIENCE, "write": PATIENCE, "pool": PATIENCE}
            request.extensions = {**request.extensions, "timeout": limits}

    def after(self, response: httpx.Response) -> None:
        """Hook of an answer, before its body is read."""
        if not self._talks:
            return
        name = _name(response.request.url)
        if (encoding := response.headers.get("Content-Encoding", "identity")) != "identity":
            raise RemoteError(f"{name} answered in the encoding {encoding!r:.40}, expected plain bytes; is it a Hub?")
        if response.status_code in _TEMPORARY and (seconds := _asked_to_wait(response)) > PATIENCE:
            text = f"{name} answered {response.status_code} and the server asks to wait {seconds:.0f} s"
            raise RemoteError(f"{text}: try again then")
        is_file = response.request.extensions.get(FILE) and response.status_code in (200, 206)
        if not is_file and isinstance(response.stream, httpx.SyncByteStream):
            response.stream = _Limited(response.stream, name)


class _Limited(httpx.SyncByteStream):
    def __init__(self, stream: httpx.SyncByteStream, name: str):
        self._stream, self._name = stream, name

    def __iter__(self) -> Iterator[bytes]:
        until, count = time.monotonic() + LONGEST_ANSWER, 0
        for piece in self._stream:
            count += len(piece)
            if count > LARGEST_ANSWER:
                raise RemoteError(f"{self._name} answered more than {LARGEST_ANSWER:,} bytes; is it a Hub?")
            if time.monotonic() > until:
                raise RemoteError(f"{self._name} took more than {LONGEST_ANSWER:.0f} s for an answer; try again later")
            yield piece

    def close(self) -> None:
        self._stream.close()


_GUARD = _Guard()
_installed = False


@contextlib.contextmanager
def guarded(endpoint: str, *, listing: bool = False) -> Iterator[None]:
    """All limits hold inside, and the token goes to `endpoint` alone. listing: what is asked for comes in pages."""
    global _installed
    if not _installed:  # once: every change of the factory closes the connections that are open
        set_client_factory(_make_client)
        _installed = True
    with _GUARD.talk(endpoint, listing=listing):
        yield


def _make_client() -> httpx.Client:
    """As huggingface_hub's own, with the guard's hooks and the least speed."""
    client = hub_http.default_client_factory()
    client.event_hooks["request"].append(_GUARD.before)
    client.event_hooks["response"].append(_GUARD.after)
    transports: list[Any] = [client._transport, *client._mounts.values()]  # pyright: ignore[reportPrivateUsage]
    for pool in {id(one): one._pool for one in transports if one is not None}.values():
        pool._network_backend = PacedBackend(pool._network_backend)  # httpx has no option for it
    return client


def _same_origin(left: httpx.URL, right: httpx.URL) -> bool:
    return (left.scheme, left.host, _port(left)) == (right.scheme, right.host, _port(right))


def _port(url: httpx.URL) -> int | None:
    return url.port or {"http": 80, "https": 443}.get(url.scheme)


def _name(url: httpx.URL) -> str:
    """Scheme, host and port: without a password or a signature."""
    return f"{url.scheme}://{url.netloc.decode(errors='replace').rpartition('@')[2]}"


def _asked_to_wait(response: httpx.Response) -> float:
    """The longest wait that the headers ask for [s], as huggingface_hub reads them; 0 where they ask for none."""
    found = _RESET.search(response.headers.get("ratelimit", ""))
    texts = [response.headers.get("Retry-After", "").strip(), found[1] if found else ""]
    return max([float(text) for text in texts if text.isdecimal()], default=0.0)
