"""Behaviour cloning: fit a policy to the expert's own demonstrations.

Every round adds demonstrations.
"""

from collections.abc import Iterator

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.results import Result
from manip_il.algorithms.rounds import Rollouts
from manip_il.algorithms.run import Run


def cloning(run: Run, c: RunConfig) -> Iterator[Result]:
    """Yield each round's result: record demonstrations, fit the policy to all so far, validate."""
    data: list[Rollouts] = []
    for i in range(c.rounds + 1):
        data.append(run.demonstrations(c.episodes_per_round if i else c.demonstrations, i))
        policy = run.fit(data)
        yield run.validate(policy)
