"""Work on all cores whose results come in order, and never more of them than there are workers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from multiprocessing import get_context

from manip_il.child_processes import bound_to_this_process, initialize_worker
from manip_il.errors import ManipError


def map_in_order[T, R](function: Callable[[T], R], items: Iterable[T], workers: int) -> Generator[tuple[T, R]]:
    """Yield each item with its result, in order; at most `workers` + 1 of them wait in memory.

    One worker is this process. Items and results are pickled for others. Raises `ManipError` where a worker dies.
    """
    if workers == 1:
        yield from ((item, function(item)) for item in items)
        return
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=initialize_worker)
    waiting: deque[tuple[T, Future[R]]] = deque()
    try:
        for item in items:
            with bound_to_this_process():  # it starts processes as they are needed
                waiting.append((item, pool.submit(function, item)))
            if len(waiting) > workers:
                yield _next(waiting)
        while waiting:
            yield _next(waiting)
    except BrokenExecutor as error:
        raise ManipError("a worker died (out of memory?); fewer --workers need less") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _next[T, R](waiting: deque[tuple[T, Future[R]]]) -> tuple[T, R]:
    item, result = waiting.popleft()
    return item, result.result()
