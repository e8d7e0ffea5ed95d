"""Bytes of large files on their way to a Hub, while they go: huggingface_hub tells nobody before a file is done."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator, Iterator

import httpx
from huggingface_hub import get_session

from manip_il.store.remote import Advance


@contextlib.contextmanager
def counted(total: int, progress: Advance) -> Generator[None]:
    """Tell `progress` of `total` bytes in all: of what is sent inside as it goes, and at the end of the rest.

    What is sent once more after a cut counts once. What goes by xet (on the public Hub) shows at the end alone.
    """
    counter = _Counter(total, progress)
    hooks = get_session().event_hooks["request"]
    hooks.append(counter.watch)
    try:
        yield
        counter.finish()
    finally:
        if counter.watch in hooks:  # a new connection after an error brings hooks of its own
            hooks.remove(counter.watch)


class _Counter:
    def __init__(self, total: int, progress: Advance):
        self._left, self._progress = total, progress
        self._sent: dict[str, int] = {}  # most bytes in one try, by URL
        self._lock = threading.Lock()

    def watch(self, request: httpx.Request) -> None:
        """A hook of the session: files are what it puts."""
        if request.method == "PUT" and isinstance(request.stream, httpx.SyncByteStream):
            request.stream = _Watched(request.stream, str(request.url), self._at)

    def finish(self) -> None:
        self._advance(self._left)

    def _at(self, url: str, position: int) -> None:
        with self._lock:
            new = position - self._sent.get(url, 0)
            if new > 0:
                self._sent[url] = position
                self._advance(min(new, self._left))

    def _advance(self, count: int) -> None:
        if count > 0:
            self._left -= count
            self._progress(count)


class _Watched(httpx.SyncByteStream):
    def __init__(self, stream: httpx.SyncByteStream, url: str, at: Callable[[str, int], None]):
        self._stream, self._url, self._at = stream, url, at

    def __iter__(self) -> Iterator[bytes]:
        position = 0
        for piece in self._stream:
            yield piece
            position += len(piece)
            self._at(self._url, position)

    def close(self) -> None:
        self._stream.close()
