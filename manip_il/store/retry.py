"""Another try, a little later, of what may then work."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from manip_il.store.errors import RemoteError, TransientError


@dataclass(frozen=True)
class Retry:
    """Exponential back-off with full jitter (Brooker 2015, "Exponential Backoff And Jitter"), on `TransientError`.

    tries: in all. first, longest: upper bounds of the first and of any wait [s]. patience: a server that asks for a
    longer wait than this is not waited for [s].
    """

    tries: int = 6
    first: float = 0.5
    longest: float = 20.0
    patience: float = 120.0
    sleep: Callable[[float], None] = time.sleep
    rng: np.random.Generator = field(default_factory=np.random.default_rng)

    def __call__[T](self, work: Callable[[], T]) -> T:
        """What `work` returns in the end; `RemoteError` with the last reason where no try worked."""
        for number in range(1, self.tries + 1):
            try:
                return work()
            except TransientError as error:
                if number == self.tries:
                    raise RemoteError(
                        f"{error}; tried {number} times, try again later: what has been transferred is kept"
                    ) from None
                self.sleep(self._wait(number, error))
        raise RemoteError("no attempts are allowed; expected at least one")

    def _wait(self, number: int, error: TransientError) -> float:
        """Seconds to wait after the `number`-th try: what the server asked for, with a little more, or ours."""
        drawn = float(self.rng.uniform(0, min(self.longest, self.first * 2 ** (number - 1))))
        if error.after is None:
            return drawn
        if error.after > self.patience:
            raise RemoteError(f"{error}; the server asks to wait {error.after:.0f} s: try again then") from None
        return error.after + min(drawn, 1.0)


def retry_after(value: str | None) -> float | None:
    """Return seconds that a Retry-After header asks to wait, given as a number or as a date.

    None where it says neither.
    """
    if value is None:
        return None
    if value.strip().isdecimal():
        return float(value)
    from email.utils import parsedate_to_datetime

    try:
        return max(0.0, parsedate_to_datetime(value).timestamp() - time.time())
    except ValueError:
        return None
