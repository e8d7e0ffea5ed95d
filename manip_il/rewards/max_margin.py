"""Maximum margin: weights for which the demonstrations cost less than all else.

Maximum margin planning (Ratliff et al. 2006) wants each demonstration to be cheaper than every other path by a margin
that grows with how far off the other goes, and descends along subgradients: the demonstration's features less those of
the path that is cheapest once the margin is taken off. Feature matching by projection (Abbeel & Ng 2004) mixes cheapest
paths until the mixture's features are no more than the demonstrations'; its weights are what still tells the two apart,
so they fade as it converges. The first gives one cost to plan with, and is what `fit` runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards.demonstrations import Demonstration, base_feature, count_features, stages
from manip_il.rewards.paths import cheapest_path, plan, plan_edges

F64 = NDArray[np.float64]
MARGIN = 0.05  # of the base feature's metres: by how much less is paid for what is off the demonstration
RIDGE = 1e-4  # times half the squared weights, beside a demonstration's metres
_STEPS = 50  # of each stage
_RATE = 1.0  # of AdaGrad: the first step of every weight
_FLAT = 1e-12


@dataclass(frozen=True)
class Margin:
    """weights: (K,), the base feature's at least 1. losses: the objective at every step, on a few first, (n,) [m]."""

    weights: F64
    losses: F64


@dataclass(frozen=True)
class Matching:
    """weights: of the last step, (K,), of length 1.

    distances: by how much the mixture's features exceeded those shown at every step, (n,) [m].
    """

    weights: F64
    distances: F64


def loss_of(demonstration: Demonstration, weights: F64, base: int, margin: float = MARGIN) -> tuple[float, F64]:
    """Return by how much a demonstration misses its margin for weights (K,), and a subgradient (K,).

    The margin of a path is `margin` times the base feature of its edges that end off the demonstration (Ratliff et al.
    2006, with the maximum over paths as in their eq. 7). Costs less margins stay above 0 for base weights of 1 or more.
    """
    problem = demonstration.problem
    off = np.ones(problem.nodes, bool)
    off[demonstration.path] = False
    loss = margin * problem.features[:, base] * off[problem.edges[:, 1]]
    planned = plan_edges(problem, problem.costs(weights) - loss)
    _, sums = cheapest_path(problem, planned, demonstration.start)
    return float(demonstration.sums @ weights - planned.costs[demonstration.start]), demonstration.sums - sums


def fit(demonstrations: Sequence[Demonstration], margin: float = MARGIN) -> Margin:
    """Return the weights of maximum margin planning: the mean of the second half of projected subgradient steps.

    Every weight is at least 0 and the base feature's at least 1, which sets the scale. Steps are AdaGrad's; the first
    ones see a few of the demonstrations.
    """
    base = base_feature(demonstrations)
    least = np.eye(count_features(demonstrations))[base]
    weights, losses = least, list[float]()
    for some in stages(demonstrations):
        squares, kept = np.zeros_like(least), list[F64]()
        for _ in range(_STEPS):
            parts = [loss_of(one, weights, base, margin) for one in some]
            losses.append(float(np.mean([loss for loss, _ in parts])) + 0.5 * RIDGE * float(weights @ weights))
            gradient = np.mean([one for _, one in parts], axis=0) + RIDGE * weights
            squares += gradient**2
            weights = np.maximum(weights - _RATE * gradient / np.sqrt(squares + _FLAT), least)
            kept.append(weights)
        weights = np.mean(kept[_STEPS // 2 :], axis=0)
    return Margin(weights, np.array(losses))


def match_features(demonstrations: Sequence[Demonstration], steps: int = 30, enough: float = 1e-3) -> Matching:
    """Return what feature matching by projection finds (Abbeel & Ng 2004, section 3.1), for weights of 0 or more.

    A step plans for the features of the mixture above the demonstrations' as weights, and mixes the path that it finds
    in by the projection onto the line between the two. It ends where the mixture exceeds no feature by more than
    `enough` [m].
    """
    shown = np.mean([one.sums for one in demonstrations], axis=0)
    mixture = _plan_all(demonstrations, np.eye(len(shown))[base_feature(demonstrations)])
    weights, distances = np.zeros_like(shown), list[float]()
    for _ in range(steps):
        above = (mixture - shown).clip(min=0.0)
        distances.append(float(np.linalg.norm(above)))
        if distances[-1] <= enough:
            break
        weights = above / distances[-1]
        step = _plan_all(demonstrations, weights) - mixture
        if (square := float(step @ step)) < _FLAT:
            break
        mixture = mixture + float(np.clip(-(step @ above) / square, 0.0, 1.0)) * step
    return Matching(weights, np.array(distances))


def _plan_all(demonstrations: Sequence[Demonstration], weights: F64) -> F64:
    """Mean features of the cheapest paths in the demonstrations' places, (K,)."""
    paths = [cheapest_path(one.problem, plan(one.problem, weights), one.start)[1] for one in demonstrations]
    return np.mean(paths, axis=0)
