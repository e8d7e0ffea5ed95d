"""Maximum entropy inverse reinforcement learning (Ziebart et al. 2008, 2010).

Among all distributions over paths with the demonstrations' expected features, the one with the
highest entropy is p(path) = exp(-w . features(path)) / Z(w). Its weights maximise the likelihood,
which is log-concave; the gradient is the difference between expected and demonstrated features. A
demonstrator that always takes the cheapest path leaves the scale of the weights undetermined, so a
normal prior bounds it.

The sum Z over paths of any length solves z = M z + e_goal with M = exp(-cost) for every edge. It is
computed by summing over longer and longer paths, relative to the cheapest path's cost to avoid
underflow. A grid of 10,000 nodes with 26 neighbours takes 5 ms, a sparse LU decomposition of I - M
170 ms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from manip_il.errors import ManipError
from manip_il.mdp import F64
from manip_il.tasks.carry.grid import LENGTH, Demonstration, PathProblem, plan, stages

PRIOR = 300.0  # standard deviation of a weight [1/m]
_MOST_STEPS = 200
_GRADIENT_TOLERANCE, _LOSS_TOLERANCE = 1e-4, 1e-6  # [m] and relative; L-BFGS-B stops below either
# smallest feature unit relative to the largest, and the smallest divisor
_LEAST_UNIT, _TINY = 1e-2, 1e-300
_ABOVE = 1.001  # safety factor on the smallest weight for which the sum over all paths is finite
_PINNED = 0.01  # distance from its lower bound at which a weight is pinned, over length's weight
_TOLERANCE = 1e-14  # relative; longer paths that add less are ignored
_MOST_EDGES = 20_000  # edges of the longest path that is summed


@dataclass(frozen=True)
class SoftPlan:
    """Distribution of the paths to a goal.

    Attributes:
        problem: The graph and its goal.
        values: Soft cost-to-go -log Z of every node, (S,), infinite if no path leads to the goal.
        chances: Probability of each edge, given its first node, (E,).
    """

    problem: PathProblem
    values: F64
    chances: F64

    def visits(self, start: int) -> F64:
        """Return the expected number of visits to each edge from node `start` on, (E,) (Ziebart et
        al. 2008, alg. 1).

        Raises `ManipError` if very long paths are likely.
        """
        moves = self.problem.matrix(self.chances).T.tocsr()
        now = np.zeros(self.problem.nodes)
        now[start] = 1.0
        total = now.copy()
        for _ in range(_MOST_EDGES):
            now = moves @ now
            total += now
            if now.sum() - now[self.problem.goal] <= _TOLERANCE:
                return total[self.problem.edges[:, 0]] * self.chances
        raise ManipError(
            f"paths of more than {_MOST_EDGES} edges are likely; expected higher costs"
        )

    def features(self, start: int) -> F64:
        """Return the expected feature sums of a path from node `start`, (K,)."""
        return self.visits(start) @ self.problem.features


def soft_plan(problem: PathProblem, weights: F64) -> SoftPlan:
    """Return the distribution of paths for weights (K,).

    Larger weights make the cheapest path more likely.

    Raises `ManipError` if the sum over all paths is infinite, because their number grows faster
    than exp(cost) (the spectral radius of the module's M is 1 or more).
    """
    costs, edges = problem.features @ weights, problem.edges
    hard = plan(problem, weights).costs
    known = np.where(np.isfinite(hard), hard, 0.0)
    leads = np.isfinite(hard)[edges[:, 1]] & (edges[:, 0] != problem.goal)
    shares = np.where(
        leads, np.exp(-(costs + known[edges[:, 1]] - known[edges[:, 0]]).clip(min=0.0)), 0.0
    )
    sums = _sum_paths(problem, shares)
    ahead, reached = sums[edges[:, 1]], sums > 0
    chances = shares * ahead / np.where(reached, sums, 1.0)[edges[:, 0]]
    values = np.where(reached, known - np.log(np.where(reached, sums, 1.0)), np.inf)
    return SoftPlan(problem, values, chances)


def _sum_paths(problem: PathProblem, shares: F64) -> F64:
    """Return the solution z (S,) of z = M z + e_goal; M has the entries `shares` (E,)."""
    matrix = problem.matrix(shares)
    found, end = np.zeros(problem.nodes), np.zeros(problem.nodes)
    end[problem.goal] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_MOST_EDGES):
            before, found = found, matrix @ found + end
            if not np.isfinite(found[problem.goal]) or not np.isfinite(found).all():
                break
            if (found - before <= _TOLERANCE * found).all():
                return found
    raise ManipError(
        "the sum over all paths is infinite: their number grows faster than their costs; expected"
        " higher weights"
    )


def loss_of(
    demonstrations: Sequence[Demonstration], weights: F64, prior: float = PRIOR
) -> tuple[float, F64]:
    """Return the negative log-posterior per demonstration and its gradient.

    Args:
        demonstrations: One or more demonstrations.
        weights: The weights, (K,) [1/m].
        prior: Standard deviation of the weights' normal prior [1/m].

    Returns:
        The loss, up to a constant, and its gradient by the weights, (K,) [m].

    Raises:
        ManipError: If a demonstration's sum over all paths is infinite (see `soft_plan`), or if its
            visits cannot be computed (see `SoftPlan.visits`).
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
    """Return the smallest weights (K,) [1/m] for which the sum over all paths is guaranteed to be
    finite.

    The weight of length is just above the log of the largest number of edges from a node, divided
    by the length of the shortest edge [m]; the other weights are 0.
    """
    found = np.zeros(demonstrations[0].problem.features.shape[1])
    shortest = min(float(one.problem.features[:, LENGTH].min()) for one in demonstrations)
    most = max(int(np.bincount(one.problem.edges[:, 0]).max()) for one in demonstrations)
    found[LENGTH] = _ABOVE * np.log(most) / shortest
    return found


def pinned(demonstrations: Sequence[Demonstration], weights: F64) -> list[int]:
    """Return the indices of the weights (K,) that `fit` left at their lower bounds.

    The demonstrations would have them even smaller.
    """
    above = weights - least_weights(demonstrations)
    return np.flatnonzero(above <= _PINNED * weights[LENGTH]).tolist()


def fit(demonstrations: Sequence[Demonstration]) -> F64:
    """Return the most likely weights (K,) [1/m], each 0 or more, by L-BFGS-B.

    The search starts from weights above `least_weights`. It fits some of the demonstrations first,
    then all of them.
    """
    least = least_weights(demonstrations)
    weights = np.maximum(2 * least, least.max() / 2)
    for some in stages(demonstrations):
        weights = _minimise(some, weights, least)
    return weights


def _minimise(demonstrations: Sequence[Demonstration], start: F64, least: F64) -> F64:
    """The most likely weights (K,).

    The optimiser scales each by its feature's initial deviation.
    """
    missed = [
        one.sums - soft_plan(one.problem, start).features(one.start) for one in demonstrations
    ]
    units = np.sqrt(np.mean(np.square(missed), axis=0))
    units = (units / max(float(units.max()), _TINY)).clip(min=_LEAST_UNIT)

    def loss(scaled: F64) -> tuple[float, F64]:
        value, gradient = loss_of(demonstrations, scaled / units)
        return value, gradient / units

    options: Any = {"maxiter": _MOST_STEPS, "gtol": _GRADIENT_TOLERANCE, "ftol": _LOSS_TOLERANCE}
    bounds = [(low, None) for low in least * units]
    found = minimize(
        loss, start * units, jac=True, method="L-BFGS-B", bounds=bounds, options=options
    )
    return np.asarray(found.x / units, np.float64)
