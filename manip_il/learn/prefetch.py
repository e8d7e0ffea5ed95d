"""The next batches are made while the network is busy with this one."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_END = object()


@contextmanager
def prefetched[T](items: Iterator[T], depth: int = 2) -> Iterator[Iterator[T]]:
    """The same items in the same order, up to `depth` of them made ahead by a thread; its errors are raised here."""
    ready: queue.Queue[object] = queue.Queue(maxsize=depth)
    stop = threading.Event()

    def put(item: object) -> bool:
        while not stop.is_set():
            try:
                ready.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def work() -> None:
        try:
            for item in items:
                if not put(item):
                    return
            put(_END)
        except BaseException as error:
            put(error)

    def take() -> Iterator[T]:
        while (item := ready.get()) is not _END:
            if isinstance(item, BaseException):
                raise item
            yield item  # type: ignore[misc]

    thread = threading.Thread(target=work, daemon=True, name="prefetch")
    thread.start()
    try:
        yield take()
    finally:
        stop.set()
        thread.join()
