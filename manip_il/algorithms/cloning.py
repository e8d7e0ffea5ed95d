"""Behaviour cloning: a policy is fitted to the expert's own demonstrations, of which every round adds some."""

from collections.abc import Iterator

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.imitation import ImitationRun
from manip_il.algorithms.rounds import Rollouts
from manip_il.algorithms.run import Result


def cloning(run: ImitationRun, c: RunConfig) -> Iterator[Result]:
    """Yield every round: demonstrate, fit to all demonstrations, validate."""
    data: list[Rollouts] = []
    for i in range(c.rounds + 1):
        data.append(run.demonstrations(c.episodes(i), i))
        policy = run.fit(data)
        yield run.validate(policy)
