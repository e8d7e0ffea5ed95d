"""Maximum margin planning (Ratliff et al. 2006): weights for which the demonstrations cost less
than all other paths.

Each demonstration must be cheaper than every other path by a margin that grows with their
difference. The weights minimise

    RIDGE / 2 |w|^2 + mean over demonstrations of max over paths p of w . (f_demo - f_p) + margin(p)

which is a quadratic programme with a constraint per path. There are too many paths to list, so
the programme has only those found so far; Dijkstra's algorithm finds the one that is violated most
(the cutting planes of Tsochantaridis et al. 2005). Its optimum is a lower bound on the objective
above; the weights are optimal once both agree.
"""

from collections.abc import Sequence

import daqp
import numpy as np

from manip_il.errors import ManipError
from manip_il.mdp import F64
from manip_il.tasks.carry.grid import LENGTH, Demonstration, plan

MARGIN = 0.05  # margin per metre of path off the demonstration
RIDGE = 1e-4  # factor of the penalty, half the squared weights
_GAP = 1e-9  # duality gap at which the weights are optimal, relative to the objective
_MOST_CUTS = 100  # paths added per demonstration
_FREE = 1e30  # no upper bound, as DAQP writes it


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


def fit(demonstrations: Sequence[Demonstration]) -> tuple[F64, float]:
    """Return the optimal weights of maximum margin planning, (K,), and the duality gap: how far
    their objective is at most above its minimum, as a share of it.

    Every weight is at least 0; the weight of length is at least 1, which sets the scale.

    Raises `ManipError` if DAQP does not solve a programme.
    """
    weights = np.eye(demonstrations[0].problem.features.shape[1])[LENGTH]
    size, count = len(weights), len(demonstrations)
    # Unknowns: the weights, and each demonstration's loss in units of RIDGE, with which DAQP is
    # exact. It minimises half the squared weights plus the mean loss, where
    # rows @ unknowns >= lower.
    lower = np.append(weights, np.zeros(count))
    rows = np.eye(size + count)
    square = np.diag(rows[:size].sum(axis=0))
    linear = rows[size:].mean(axis=0)
    best, bound = weights, 0.0
    objective = np.inf
    for _ in range(_MOST_CUTS):
        found = [loss_of(one, weights) for one in demonstrations]
        losses, slopes = (np.array(part) for part in zip(*found, strict=True))
        value = losses.mean() + RIDGE / 2 * weights @ weights
        if value < objective:
            best, objective = weights, value
        if objective - bound <= _GAP * objective:
            break
        rows = np.append(rows, np.hstack([-slopes, RIDGE * np.eye(count)]), axis=0)
        lower = np.append(lower, losses - slopes @ weights)
        free, sense = np.full(len(lower), _FREE), np.zeros(len(lower), np.intc)
        unknowns, least, flag, _ = daqp.solve(square, linear, rows, free, lower, sense)
        if flag <= 0:
            raise ManipError(f"DAQP does not solve the maximum margin programme (exit flag {flag})")
        weights, bound = unknowns[:size].clip(min=lower[:size]), RIDGE * least
    return best, max(1 - bound / objective, 0.0)
