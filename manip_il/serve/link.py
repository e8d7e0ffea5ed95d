"""A connection that carries messages late, and loses some."""

from collections import deque

import numpy as np

from manip_il.serve.config import SessionConfig


class Link[T]:
    """Carries values from one side to the other; the newest that has arrived counts.

    Args:
        config: Options of the session: `latency`, `jitter` and `drop`.
        first: What has arrived at the beginning.
        rng: Draws delays and losses.
    """

    def __init__(self, config: SessionConfig, first: T, rng: np.random.Generator):
        self._config, self._rng = config, rng
        self._arrived = first
        self._on_the_way = deque[tuple[float, T]]()

    def send(self, now: float, value: T) -> None:
        """Send a value at a moment [s]."""
        lost, late = self._rng.uniform(size=2)
        if lost >= self._config.drop:
            due = now + self._config.latency + late * self._config.jitter
            self._on_the_way.append((due, value))

    def receive(self, now: float) -> T:
        """Return the value that was sent last of those that have arrived at a moment [s]."""
        due = [place for place, (when, _) in enumerate(self._on_the_way) if when <= now]
        for _ in range(due[-1] + 1 if due else 0):  # one that was overtaken does not count
            _, self._arrived = self._on_the_way.popleft()
        return self._arrived
