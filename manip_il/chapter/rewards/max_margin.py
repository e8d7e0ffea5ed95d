"""Maximum margin planning (Ratliff et al. 2006): weights for which the demonstrations cost less
than all other paths.

Each demonstration must be cheaper than every other path by a margin that grows with their
difference. A subgradient is the demonstration's features minus those of the path that is cheapest
after the margin is subtracted.
"""

from collections.abc import Sequence

import numpy as np

from manip_il.mdp import F64
from manip_il.tasks.carry.grid import LENGTH, Demonstration, plan, stages

MARGIN = 0.05  # margin per metre of path off the demonstration
RIDGE = 1e-4  # factor of the penalty, half the squared weights
_STEPS = 50  # subgradient steps in each stage
_RATE = 1.0  # AdaGrad's learning rate, the size of each weight's first step
_EPSILON = 1e-12


def loss_of(demonstration: Demonstration, weights: F64) -> tuple[float, F64]:
    """Return the margin violation of a demonstration and a subgradient.

    The margin of a path is `MARGIN` times the length of its edges that end off the demonstration
    (Ratliff et al. 2006, with the maximum over paths as in their eq. 7).

    Args:
        demonstration: The demonstration.
        weights: The weights, (K,). Costs minus margins are positive if length's weight is 1 or
            more.

    Returns:
        How much the demonstration costs above the cheapest path after margins are subtracted, and a
        subgradient by the weights, (K,) [m].

    Raises:
        ManipError: If no path leads from the demonstration's start to the goal.
    """
    problem = demonstration.problem
    off = np.ones(problem.nodes, bool)
    off[demonstration.path] = False
    loss = MARGIN * problem.features[:, LENGTH] * off[problem.edges[:, 1]]
    planned = plan(problem, weights, loss)
    _, sums = planned.path(demonstration.start)
    return (
        float(demonstration.sums @ weights - planned.costs[demonstration.start]),
        demonstration.sums - sums,
    )


def fit(demonstrations: Sequence[Demonstration]) -> F64:
    """Return the weights (K,) of maximum margin planning: the mean over the second half of
    projected subgradient steps.

    Every weight is at least 0; the weight of length is at least 1, which sets the scale. The step
    sizes are AdaGrad's. The first steps use some of the demonstrations, the later ones all.
    """
    least = np.eye(demonstrations[0].problem.features.shape[1])[LENGTH]
    weights = least
    for some in stages(demonstrations):
        squares, kept = np.zeros_like(least), list[F64]()
        for _ in range(_STEPS):
            gradient = np.mean([loss_of(one, weights)[1] for one in some], axis=0) + RIDGE * weights
            squares += gradient**2
            weights = np.maximum(weights - _RATE * gradient / np.sqrt(squares + _EPSILON), least)
            kept.append(weights)
        weights = np.mean(kept[_STEPS // 2 :], axis=0)
    return weights
