"""Maximum margin planning (Ratliff et al. 2006): weights for which the demonstrations cost less than all else.

Each demonstration is to be cheaper than every other path by a margin that grows with how far off the other goes. A
subgradient is the demonstration's features less those of the path that is cheapest once the margin is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards.paths import LENGTH, Demonstration, cheapest_path, plan_edges, stages

F64 = NDArray[np.float64]
MARGIN = 0.05  # of a path's length: by how much less is paid for what is off the demonstration
RIDGE = 1e-4  # times half the squared weights, beside a demonstration's metres
_STEPS = 50  # of each stage
_RATE = 1.0  # of AdaGrad: the first step of every weight
_FLAT = 1e-12


def loss_of(demonstration: Demonstration, weights: F64, margin: float = MARGIN) -> tuple[float, F64]:
    """Return by how much a demonstration misses its margin for weights (K,), and a subgradient (K,).

    The margin of a path is `margin` times the length of its edges that end off the demonstration (Ratliff et al. 2006,
    with the maximum over paths as in their eq. 7). Costs less margins stay above 0 if length's weight is 1 or more.
    """
    problem = demonstration.problem
    off = np.ones(problem.nodes, bool)
    off[demonstration.path] = False
    loss = margin * problem.features[:, LENGTH] * off[problem.edges[:, 1]]
    planned = plan_edges(problem, problem.costs(weights) - loss)
    _, sums = cheapest_path(problem, planned, demonstration.start)
    return float(demonstration.sums @ weights - planned.costs[demonstration.start]), demonstration.sums - sums


def fit(demonstrations: Sequence[Demonstration], margin: float = MARGIN) -> F64:
    """Return the weights (K,) of maximum margin planning: the mean of the second half of projected subgradient steps.

    Every weight is at least 0 and length's at least 1, which sets the scale. Steps are AdaGrad's; the first ones see a
    few of the demonstrations.
    """
    least = np.eye(demonstrations[0].problem.features.shape[1])[LENGTH]
    weights = least
    for some in stages(demonstrations):
        squares, kept = np.zeros_like(least), list[F64]()
        for _ in range(_STEPS):
            gradient = np.mean([loss_of(one, weights, margin)[1] for one in some], axis=0) + RIDGE * weights
            squares += gradient**2
            weights = np.maximum(weights - _RATE * gradient / np.sqrt(squares + _FLAT), least)
            kept.append(weights)
        weights = np.mean(kept[_STEPS // 2 :], axis=0)
    return weights
