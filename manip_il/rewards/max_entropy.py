"""Maximum entropy inverse reinforcement learning (Ziebart et al. 2008, 2010).

Of all distributions over paths whose expected features are the demonstrations', the one of most entropy is
p(path) = exp(-w . features(path)) / Z(w). Its weights are those of the greatest likelihood, which is concave; the
gradient is the difference between expected and demonstrated features. Who always takes the cheapest path leaves the
scale of the weights open, so a normal prior holds it.

The sum Z over paths of every length solves z = M z + e_goal, M = exp(-cost) of every edge. It is found by summing over
ever longer paths, relative to the cheapest path's cost, so that nothing underflows: on a grid of 10,000 nodes with 26
neighbours in 5 ms, where a sparse LU decomposition of I - M takes 170 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from manip_il.errors import ManipError
from manip_il.rewards.paths import LENGTH, Demonstration, PathProblem, plan, stages

F64 = NDArray[np.float64]
PRIOR = 300.0  # standard deviation of a weight [1/m]
_MOST_STEPS = 200
_ENOUGH, _SAME = 1e-4, 1e-6  # gradient [m] and relative gain of a step at which it ends
_LEAST_UNIT, _TINY = 1e-2, 1e-300  # of a feature, in the largest
_ABOVE = 1.001  # times the least weight for which the sum over all paths is finite
_NO_MORE = 1e-14  # share that longer paths may still add
_MOST_EDGES = 20_000  # of a path


@dataclass(frozen=True)
class SoftPlan:
    """Distribution of the paths to a goal.

    values: soft cost-to-go -log Z of every node, (S,), infinite where no path leads to the goal. chances: with which
    each edge is taken by who is at its beginning, (E,).
    """

    problem: PathProblem
    values: F64
    chances: F64

    @cached_property
    def _moves(self) -> Any:
        return self.problem.matrix(self.chances).T.tocsr()

    def visits(self, start: int) -> F64:
        """Return how often every edge is passed on the way from a start, expected, (E,) (Ziebart et al. 2008, alg. 1).

        Raises `ManipError` where no path leads to the goal.
        """
        if not np.isfinite(self.values[start]):
            raise ManipError(f"no path leads from node {start} to the goal")
        now = np.zeros(self.problem.nodes)
        now[start] = 1.0
        total = now.copy()
        for _ in range(_MOST_EDGES):
            now = self._moves @ now
            total += now
            if now.sum() - now[self.problem.goal] <= _NO_MORE:
                return total[self.problem.edges[:, 0]] * self.chances
        raise ManipError(f"paths of more than {_MOST_EDGES} edges are likely; expected higher costs")

    def features(self, start: int) -> F64:
        """Return the expected sums of the features on the way from a start, (K,)."""
        return self.visits(start) @ self.problem.features


def soft_plan(problem: PathProblem, weights: F64) -> SoftPlan:
    """Return the distribution of paths for weights (K,); the larger they are, the closer it is to the cheapest path.

    Raises `ManipError` where the sum over all paths is infinite, because steps cost less than the choice between them
    adds (the spectral radius of M is 1 or more).
    """
    costs, edges = problem.costs(weights), problem.edges
    hard = plan(problem, weights).costs
    known = np.where(np.isfinite(hard), hard, 0.0)
    leads = np.isfinite(hard)[edges[:, 1]] & (edges[:, 0] != problem.goal)
    shares = np.where(leads, np.exp(-(costs + known[edges[:, 1]] - known[edges[:, 0]]).clip(min=0.0)), 0.0)
    sums = _sum_paths(problem, shares)
    ahead, reached = sums[edges[:, 1]], sums > 0
    chances = shares * ahead / np.where(reached, sums, 1.0)[edges[:, 0]]
    values = np.where(reached, known - np.log(np.where(reached, sums, 1.0)), np.inf)
    return SoftPlan(problem, values, chances)


def _sum_paths(problem: PathProblem, shares: F64) -> F64:
    """Solve z = M z + e_goal for the matrix of `shares` (E,), (S,)."""
    matrix = problem.matrix(shares)
    found, end = np.zeros(problem.nodes), np.zeros(problem.nodes)
    end[problem.goal] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_MOST_EDGES):
            before, found = found, matrix @ found + end
            if not np.isfinite(found[problem.goal]) or not np.isfinite(found).all():
                break
            if (found - before <= _NO_MORE * found).all():
                return found
    raise ManipError(
        "the sum over all paths is infinite: steps cost less than the choice between them adds; expected higher weights"
    )


def loss_of(demonstrations: Sequence[Demonstration], weights: F64, prior: float = PRIOR) -> tuple[float, F64]:
    """Return the mean negative log-likelihood with the prior's share, and its gradient (K,).

    Raises what `soft_plan` raises.
    """
    count = len(demonstrations)
    loss = 0.5 * float(weights @ weights) / (prior**2 * count)
    gradient = weights / (prior**2 * count)
    for one in demonstrations:
        planned = soft_plan(one.problem, weights)
        loss += (float(one.sums @ weights) - float(planned.values[one.start])) / count
        gradient = gradient + (one.sums - planned.features(one.start)) / count
    return loss, gradient


def least_weights(demonstrations: Sequence[Demonstration]) -> F64:
    """Return weights (K,) [1/m] from which on the sum over all paths is finite: a step outweighs the choice of it.

    That is log(most edges of a node) over the shortest edge for length, and 0 for the other features.
    """
    found = np.zeros(demonstrations[0].problem.features.shape[1])
    shortest = min(float(one.problem.features[:, LENGTH].min()) for one in demonstrations)
    most = max(int(np.bincount(one.problem.edges[:, 0]).max()) for one in demonstrations)
    found[LENGTH] = _ABOVE * np.log(most) / shortest
    return found


def fit(demonstrations: Sequence[Demonstration], prior: float = PRIOR) -> F64:
    """Return the most likely weights (K,) [1/m], each 0 or more, by L-BFGS-B; the larger, the surer. prior: [1/m].

    It begins from twice the least weights on a few of the demonstrations, and goes on from there on all.
    """
    least = least_weights(demonstrations)
    weights = np.maximum(2 * least, least.max() / 2)
    for some in stages(demonstrations):
        weights = _minimise(some, weights, least, prior)
    return weights


def _minimise(demonstrations: Sequence[Demonstration], start: F64, least: F64, prior: float) -> F64:
    """The most likely weights (K,), in units of the features' deviations from what is expected."""
    missed = [one.sums - soft_plan(one.problem, start).features(one.start) for one in demonstrations]
    units = np.sqrt(np.mean(np.square(missed), axis=0))
    units = (units / max(float(units.max()), _TINY)).clip(min=_LEAST_UNIT)

    def loss(scaled: F64) -> tuple[float, F64]:
        value, gradient = loss_of(demonstrations, scaled / units, prior)
        return value, gradient / units

    options: Any = {"maxiter": _MOST_STEPS, "gtol": _ENOUGH, "ftol": _SAME}
    bounds = [(low, None) for low in least * units]
    found = minimize(loss, start * units, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x / units, np.float64)
