"""Behaviour cloning: a policy is fitted to the expert's own demonstrations, of which every round adds some."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from manip_il.algorithms.rounds import Rollouts, RoundResult

if TYPE_CHECKING:
    from manip_il.algorithms.config import RunConfig
    from manip_il.algorithms.run import Run


def cloning(run: Run, c: RunConfig) -> Iterator[RoundResult]:
    """Yield every round: demonstrate, fit to all demonstrations, validate."""
    data: list[Rollouts] = []
    for i in range(c.rounds + 1):
        data.append(run.demonstrations(c.episodes(i), i))
        policy = run.fit(data)
        yield run.validate(policy)
