"""Maximum entropy inverse reinforcement learning (Ziebart et al. 2008, 2010).

Of all distributions over paths whose expected features are the demonstrations', the one of most entropy is
p(path) = exp(-w . features(path)) / Z(w). Its weights are those of the greatest likelihood, which is concave; the
gradient is the difference between expected and demonstrated features. Who always takes the cheapest path leaves the
scale of the weights open, so a normal prior holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from manip_il.rewards.demonstrations import LENGTH, Demonstration, stages
from manip_il.rewards.soft import soft_plan

F64 = NDArray[np.float64]
PRIOR = 300.0  # standard deviation of a weight [1/m]
_MOST_STEPS = 200
_ENOUGH, _SAME = 1e-4, 1e-6  # gradient [m] and relative gain of a step at which it ends
_LEAST_UNIT, _TINY = 1e-2, 1e-300  # of a feature, in the largest
_ABOVE = 1.001  # times the least weight for which the sum over all paths is finite


@dataclass(frozen=True)
class Entropy:
    """weights: (K,) [1/m], their scale the certainty. expected, demonstrated: mean features of a path, (K,) [m]."""

    weights: F64
    expected: F64
    demonstrated: F64
    evaluations: int


def loss_of(demonstrations: Sequence[Demonstration], weights: F64, prior: float = PRIOR) -> tuple[float, F64, F64]:
    """Return the mean negative log-likelihood with the prior's share, its gradient (K,), mean expected features (K,).

    Raises what `soft_plan` raises.
    """
    count = len(demonstrations)
    loss = 0.5 * float(weights @ weights) / (prior**2 * count)
    gradient, expected = weights / (prior**2 * count), np.zeros_like(weights)
    for one in demonstrations:
        planned = soft_plan(one.problem, weights)
        loss += (float(one.sums @ weights) - float(planned.values[one.start])) / count
        features = planned.features(one.start)
        expected += features / count
        gradient = gradient + (one.sums - features) / count
    return loss, gradient, expected


def least_weights(demonstrations: Sequence[Demonstration]) -> F64:
    """Return weights (K,) [1/m] from which on the sum over all paths is finite: a step outweighs the choice of it.

    That is log(most edges of a node) over the shortest edge for length, and 0 for the other features.
    """
    found = np.zeros(demonstrations[0].problem.features.shape[1])
    shortest = min(float(one.problem.features[:, LENGTH].min()) for one in demonstrations)
    most = max(int(np.bincount(one.problem.edges[:, 0]).max()) for one in demonstrations)
    found[LENGTH] = _ABOVE * np.log(most) / shortest
    return found


def fit(demonstrations: Sequence[Demonstration], prior: float = PRIOR) -> Entropy:
    """Return the most likely weights, each 0 or more, by L-BFGS-B. prior: [1/m].

    It begins from twice the least weights on a few of the demonstrations, and goes on from there on all.
    """
    least = least_weights(demonstrations)
    weights, evaluations = np.maximum(2 * least, least.max() / 2), 0
    for some in stages(demonstrations):
        weights, more = _minimise(some, weights, least, prior)
        evaluations += more
    *_, expected = loss_of(demonstrations, weights, prior)
    return Entropy(weights, expected, np.mean([one.sums for one in demonstrations], axis=0), evaluations)


def _minimise(demonstrations: Sequence[Demonstration], start: F64, least: F64, prior: float) -> tuple[F64, int]:
    """The most likely weights (K,), and evaluations, in units of the features' deviations from what is expected."""
    missed = [one.sums - soft_plan(one.problem, start).features(one.start) for one in demonstrations]
    units = np.sqrt(np.mean(np.square(missed), axis=0))
    units = (units / max(float(units.max()), _TINY)).clip(min=_LEAST_UNIT)

    def loss(scaled: F64) -> tuple[float, F64]:
        value, gradient, _ = loss_of(demonstrations, scaled / units, prior)
        return value, gradient / units

    options: Any = {"maxiter": _MOST_STEPS, "gtol": _ENOUGH, "ftol": _SAME}
    bounds = [(low, None) for low in least * units]
    found = minimize(loss, start * units, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x / units, np.float64), int(found.nfev)
