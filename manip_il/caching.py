"""A cache for objects that have a state, such as worlds and solvers: every thread has its own."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable


class PerThread[**P, R](threading.local):
    """`functools.lru_cache`, except that a value belongs to the thread that made it.

    Two threads that shared one world or one solver would compute with each other's numbers.

    Attributes:
        own: The calling thread's cache.
    """

    def __init__(self, function: Callable[P, R], size: int | None):
        self.own = functools.lru_cache(size)(function)  # called again in every thread

    def __call__(self, *arguments: P.args, **options: P.kwargs) -> R:
        """Return the function's value for these arguments."""
        return self.own(*arguments, **options)


def cached_per_thread[**P, R](
    size: int | None = None,
) -> Callable[[Callable[P, R]], PerThread[P, R]]:
    """Return a decorator that keeps a function's last `size` values, all of them if None, for
    each thread.
    """
    return lambda function: PerThread(function, size)
