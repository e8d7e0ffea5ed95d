"""Bytes on their way, as progress: how many of how many, and how fast."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from manip_il.cli.interrupt import Interrupted
from manip_il.cli.progress import progress

_UNITS = ("B", "kB", "MB", "GB", "TB")
SHOWN = 0.1  # between two changes of what is shown [s]


@contextmanager
def moved(total: int, what: str) -> Generator[Callable[[int], None]]:
    """Give a function that is told, from any thread, of so many bytes more; nothing is shown where there are none."""
    if not total:
        yield lambda count: None
        return
    lock, start = threading.Lock(), time.monotonic()
    done = waiting = 0
    shown = start

    def advance(count: int) -> None:
        nonlocal done, waiting, shown
        with lock:
            done, waiting = done + count, waiting + count
            now = time.monotonic()
            if now - shown >= SHOWN or done >= total:
                fields = {"of": bytes_text(total), "rate": f"{bytes_text(done / max(now - start, 1e-9))}/s"}
                bar.advance(waiting, **fields)
                waiting, shown = 0, now

    with progress(total, f"{what} [bytes]") as bar:
        yield advance


def bytes_text(count: float) -> str:
    """As people read it: `1.2 GB`."""
    unit = 0
    while count >= 999.5 and unit < len(_UNITS) - 1:
        count, unit = count / 1000, unit + 1
    return f"{count:.0f} {_UNITS[unit]}" if unit == 0 else f"{count:.3g} {_UNITS[unit]}"


@contextmanager
def going_on() -> Generator[None]:
    """Ctrl-C inside says that the command, given again, goes on from there."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted("what has come so far", "the same command") from None
