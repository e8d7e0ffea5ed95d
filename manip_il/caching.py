"""A cache for objects that have a state, such as worlds and solvers: every thread has its own."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable


class PerThread[**P, R]:
    """`functools.lru_cache`, except that a value belongs to the thread that made it.

    Two threads that shared one world or one solver would compute with each other's numbers.
    """

    def __init__(self, function: Callable[P, R], size: int | None):
        self._function, self._size = function, size
        self._own = threading.local()

    @property
    def own(self) -> functools._lru_cache_wrapper[R]:
        """The calling thread's cache."""
        if not hasattr(self._own, "cache"):
            self._own.cache = functools.lru_cache(self._size)(self._function)
        return self._own.cache

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
