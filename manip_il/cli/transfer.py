"""Bytes on their way, as progress: how many of how many, and how fast."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from manip_il.cli.interrupt import Interrupted
from manip_il.cli.progress import progress

SHOWN = 0.1  # between two changes of what is shown [s]


@contextmanager
def moved(total: int, what: str) -> Generator[Callable[[int], None]]:
    """Give a function that is told, from any thread, of so many bytes more; nothing is shown where there are none."""
    if not total:
        yield lambda count: None
        return
    lock, shown = threading.Lock(), time.monotonic()
    done = waiting = 0

    def advance(count: int) -> None:
        nonlocal done, waiting, shown
        with lock:
            done, waiting = done + count, waiting + count
            now = time.monotonic()
            if now - shown >= SHOWN or done >= total:
                bar.advance(waiting)
                waiting, shown = 0, now

    with progress(total, what, of_bytes=True) as bar:
        yield advance


@contextmanager
def going_on() -> Generator[None]:
    """Ctrl-C inside says that the command, given again, goes on from there."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted("what has been transferred so far", "the same command") from None
