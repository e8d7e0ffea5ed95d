"""Keep the scheduling of threads through what would change it."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

_THREADS = Path("/proc/self/task")  # of this process, by number


@contextlib.contextmanager
def scheduling_kept() -> Iterator[None]:
    """Give this thread, and all that start inside, the scheduling that this thread had.

    SVT-AV1, where root runs it, makes the thread that opens an encoder, and its own, real-time ones (SCHED_FIFO, 99),
    for good: these, and every process that they start, would starve all others.
    """
    if sys.platform != "linux" or os.geteuid() != 0:
        yield
        return
    before, running = (os.sched_getscheduler(0), os.sched_getparam(0)), set(os.listdir(_THREADS))
    try:
        yield
    finally:
        for thread in {"0"} | (set(os.listdir(_THREADS)) - running):  # 0 is this one
            with contextlib.suppress(OSError):  # it has ended
                os.sched_setscheduler(int(thread), *before)
