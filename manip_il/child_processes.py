"""Pools of worker processes on this machine. They end with the process that started them, also if that was killed.

Workers are forked from a server that has imported what they need and nothing else: they share neither OpenGL nor
threads, and the import of torch, seconds of work, is paid once.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from multiprocessing import forkserver, resource_tracker

from manip_il.errors import ManipError

_CONTEXT = multiprocessing.get_context("forkserver")


def start_server(preload: Sequence[str] = ()) -> None:
    """Start the server that workers are forked from, in the background; once a process.

    preload: modules that it imports. It has the environment variables of this moment, but one thread for arithmetic.
    """
    _CONTEXT.set_forkserver_preload(list(preload))
    threads = os.environ.get("OMP_NUM_THREADS")
    resource_tracker.ensure_running()  # first, as its own start would undo the mask
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for this process alone
    os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is imported; one core each
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads


def open_pool(workers: int, preload: Sequence[str] = ()) -> ProcessPoolExecutor:
    """Return a pool of so many processes, which are started as they are needed."""
    start_server(preload)
    return ProcessPoolExecutor(workers, mp_context=_CONTEXT, initializer=end_with_parent)


def kill_pool(pool: ProcessPoolExecutor) -> None:
    """End a pool's processes, whatever they are doing."""
    for process in list((pool._processes or {}).values()):  # pyright: ignore[reportPrivateUsage]  # public from 3.14 on
        process.kill()
    pool.shutdown(cancel_futures=True)


def end_with_parent() -> None:
    """End this process, a child of `multiprocessing`, when the one that started it ends."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def map_in_order[T, R](function: Callable[[T], R], items: Iterable[T], workers: int) -> Generator[tuple[T, R]]:
    """Yield each item with its result, in order; at most `workers` + 1 of them wait in memory.

    One worker is this process. Items and results are pickled for others. Raises `ManipError` if a worker dies.
    """
    if workers == 1:
        yield from ((item, function(item)) for item in items)
        return
    waiting: deque[tuple[T, Future[R]]] = deque()
    pool = open_pool(workers)
    try:
        for item in items:
            waiting.append((item, pool.submit(function, item)))
            if len(waiting) > workers:
                yield _first(waiting)
        while waiting:
            yield _first(waiting)
    except BrokenExecutor as error:
        raise ManipError("a worker died (out of memory?); fewer --workers need less") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _first[T, R](waiting: deque[tuple[T, Future[R]]]) -> tuple[T, R]:
    item, result = waiting.popleft()
    return item, result.result()
