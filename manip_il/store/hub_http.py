"""The HTTP client for huggingface_hub: every wait has a limit, every answer an end, every connection a least speed.

The token goes to the endpoint's origin (scheme, host, port) alone.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from typing import Any

import httpcore
import httpx
from huggingface_hub import set_client_factory
from huggingface_hub.utils._http import default_client_factory  # pyright: ignore[reportPrivateUsage]

from manip_il.store.errors import Pace, RemoteError
from manip_il.store.remote import Advance

CONNECT, PATIENCE = 20.0, 120.0  # until a connection is there, until the next byte [s]
LARGEST_ANSWER, LONGEST_ANSWER = 2**26, 600.0  # of anything but a file [bytes], [s]
MOST_PAGES, LONGEST_LISTING = 5_000, 3600.0  # of one list: requests, [s]
FILE = "manip_il.file"  # extension of a request whose answer is a file, which is measured where it is written
TEMPORARY = (408, 429, 500, 502, 503, 504)  # after which huggingface_hub waits for as long as it is told
_RESET = re.compile(r";\s*t\s*=\s*(\d+)")  # of the `ratelimit` header [s]
_PIECE = 16 * 1024  # of a request that is sent between two looks at the clock [bytes]


@dataclass
class _Listing:
    """Budget of one list: pages left, and the time of its end."""

    pages: int
    until: float


def _check_request(request: httpx.Request) -> None:
    """Check and change a request, a redirected one too."""
    endpoint = next(reversed(_endpoints), None)
    if endpoint is None:
        return
    if not _same_origin(request.url, httpx.URL(endpoint)):
        request.headers.pop("Authorization", None)
    request.headers["Accept-Encoding"] = "identity"  # so that a size is the size of the content
    if (listing := _listing.get()) is not None:
        listing.pages -= 1
        if listing.pages < 0 or time.monotonic() > listing.until:
            text = f"more than {MOST_PAGES:,} pages" if listing.pages < 0 else f"more than {LONGEST_LISTING:.0f} s"
            raise RemoteError(f"{_name(request.url)} has a list of {text}; is it a Hub?")
    given = request.extensions.get("timeout") or {}
    if all(value is None for value in given.values()):
        limits = {"connect": CONNECT, "read": PATIENCE, "write": PATIENCE, "pool": PATIENCE}
        request.extensions = {**request.extensions, "timeout": limits}
    for counter in _counters:
        if request.method == "PUT" and isinstance(request.stream, httpx.SyncByteStream):
            request.stream = _Filtered(request.stream, partial(counter.count, str(request.url)))


def _check_response(response: httpx.Response) -> None:
    """Check an answer, before its body is read."""
    if not _endpoints:
        return
    name = _name(response.request.url)
    if (encoding := response.headers.get("Content-Encoding", "identity")) != "identity":
        raise RemoteError(f"{name} answered in the encoding {encoding!r:.40}, expected plain bytes; is it a Hub?")
    if response.status_code in TEMPORARY and (seconds := _requested_wait(response)) > PATIENCE:
        text = f"{name} answered {response.status_code} and the server asks to wait {seconds:.0f} s"
        raise RemoteError(f"{text}: try again then")
    is_file = response.request.extensions.get(FILE) and response.status_code in (200, 206)
    if not is_file and isinstance(response.stream, httpx.SyncByteStream):
        response.stream = _Filtered(response.stream, partial(_check_answer, name))


class _Filtered(httpx.SyncByteStream):
    """Stream whose pieces pass through a generator."""

    def __init__(self, stream: httpx.SyncByteStream, through: Callable[[Iterable[bytes]], Iterator[bytes]]):
        self._stream, self._through = stream, through

    def __iter__(self) -> Iterator[bytes]:
        return self._through(self._stream)

    def close(self) -> None:
        self._stream.close()


def _check_answer(name: str, pieces: Iterable[bytes]) -> Iterator[bytes]:
    until, count = time.monotonic() + LONGEST_ANSWER, 0
    for piece in pieces:
        count += len(piece)
        if count > LARGEST_ANSWER:
            raise RemoteError(f"{name} answered more than {LARGEST_ANSWER:,} bytes; is it a Hub?")
        if time.monotonic() > until:
            raise RemoteError(f"{name} took more than {LONGEST_ANSWER:.0f} s for an answer; try again later")
        yield piece


class _Counter:
    """Count of uploaded bytes: what is sent again after a cut counts once."""

    def __init__(self, total: int, progress: Advance):
        self.left, self._progress = total, progress
        self._sent: dict[str, int] = {}  # most bytes in one try, by URL
        self._lock = threading.Lock()

    def count(self, url: str, pieces: Iterable[bytes]) -> Iterator[bytes]:
        position = 0
        for piece in pieces:
            yield piece
            position += len(piece)
            with self._lock:
                new = position - self._sent.get(url, 0)
                if new > 0:
                    self._sent[url] = position
                    self.advance(min(new, self.left))

    def advance(self, count: int) -> None:
        if count > 0:
            self.left -= count
            self._progress(count)


_endpoints: list[str] = []  # of those who are inside `limited`: the hooks apply while there are any
_listing: ContextVar[_Listing | None] = ContextVar("listing", default=None)
_counters: list[_Counter] = []
_installed = False


@contextlib.contextmanager
def limited(endpoint: str, *, listing: bool = False) -> Generator[None]:
    """Apply all limits inside, and send the token to `endpoint` alone. listing: the answer comes in pages."""
    global _installed
    if not _installed:  # once: every change of the factory closes the connections that are open
        set_client_factory(_make_client)
        _installed = True
    before = _listing.set(_Listing(MOST_PAGES, time.monotonic() + LONGEST_LISTING) if listing else None)
    _endpoints.append(endpoint)
    try:
        yield
    finally:
        _endpoints.remove(endpoint)
        _listing.reset(before)


@contextlib.contextmanager
def counted(total: int, progress: Advance) -> Generator[None]:
    """Report `total` bytes to `progress`: those of uploads inside while they go, the rest at the end.

    huggingface_hub reports no file before it is done. What goes by xet (on the public Hub) counts at the end.
    """
    counter = _Counter(total, progress)
    _counters.append(counter)
    try:
        yield
        counter.advance(counter.left)
    finally:
        _counters.remove(counter)


def _make_client() -> httpx.Client:
    """Make huggingface_hub's own client, with our hooks and the least speed."""
    client = default_client_factory()
    client.event_hooks["request"].append(_check_request)
    client.event_hooks["response"].append(_check_response)
    transports: list[Any] = [client._transport, *client._mounts.values()]  # pyright: ignore[reportPrivateUsage]
    for pool in {id(one): one._pool for one in transports if one is not None}.values():
        pool._network_backend = _PacedBackend(pool._network_backend)  # httpx has no option for it
    return client


class _PacedBackend(httpcore.NetworkBackend):
    """Backend of httpcore whose TCP connections keep to the least speed."""

    def __init__(self, inner: httpcore.NetworkBackend):
        self._inner = inner
        self.connect_unix_socket, self.sleep = inner.connect_unix_socket, inner.sleep

    def connect_tcp(self, host: str, port: int, *options: Any, **named: Any) -> httpcore.NetworkStream:
        return _PacedStream(self._inner.connect_tcp(host, port, *options, **named), f"{host}:{port}")


class _PacedStream(httpcore.NetworkStream):
    """Connection that keeps to the least speed, once an answer has begun and while a request is sent."""

    def __init__(self, inner: httpcore.NetworkStream, name: str):
        self._inner, self._name = inner, name
        self._sent, self._received = Pace(name), Pace(name)
        self._answering = False
        self.close, self.get_extra_info = inner.close, inner.get_extra_info

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        started = time.monotonic()
        data = self._inner.read(max_bytes, timeout)
        if self._answering:  # a server may have to work for its first bytes; there is a time limit for that
            self._received.add(time.monotonic() - started, len(data))
        self._answering = True
        return data

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        if self._answering:
            self._answering, self._received = False, Pace(self._name)
        for start in range(0, len(buffer), _PIECE):
            piece, started = buffer[start : start + _PIECE], time.monotonic()
            self._inner.write(piece, timeout)
            self._sent.add(time.monotonic() - started, len(piece))

    def start_tls(self, *options: Any, **named: Any) -> httpcore.NetworkStream:
        return _PacedStream(self._inner.start_tls(*options, **named), self._name)


def _same_origin(left: httpx.URL, right: httpx.URL) -> bool:
    return (left.scheme, left.host, left.port) == (right.scheme, right.host, right.port)  # httpx drops usual ports


def _name(url: httpx.URL) -> str:
    """Return scheme, host and port, without a password or a signature."""
    return f"{url.scheme}://{url.netloc.decode(errors='replace').rpartition('@')[2]}"


def _requested_wait(response: httpx.Response) -> float:
    """Return the longest wait in the headers, as huggingface_hub reads them [s]; 0 if they ask for none."""
    found = _RESET.search(response.headers.get("ratelimit", ""))
    texts = [response.headers.get("Retry-After", "").strip(), found[1] if found else ""]
    return max([float(text) for text in texts if text.isdecimal()], default=0.0)
