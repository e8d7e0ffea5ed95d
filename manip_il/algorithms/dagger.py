"""Dataset aggregation: Ross, Gordon & Bagnell 2011, algorithm 3.1, with the expert's
demonstrations as round 0.
"""

from collections.abc import Iterator

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.results import Result
from manip_il.algorithms.rounds import mixture
from manip_il.algorithms.run import Run


def dagger(run: Run, c: RunConfig) -> Iterator[Result]:
    """Yield each round's result: roll out the learner, query the expert in its states,
    aggregate, refit, validate.
    """
    data = [run.demonstrations(c.demonstrations)]
    policy = run.fit(data)
    yield run.validate(policy)
    for i in range(1, c.rounds + 1):
        data.append(
            run.rollouts(i, mixture(policy, c.beta(i)), query=c.query, disturbed=c.disturbed_share)
        )
        policy = run.fit(data)
        yield run.validate(policy)
