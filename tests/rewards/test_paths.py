"""Cheapest paths are those that dynamic programming and listing all paths find."""

import numpy as np
import pytest

from manip_il.tasks.carry.grid import plan
from tests.rewards.grids import acyclic, all_paths, grid


def test_the_cheapest_path_is_the_best_of_all():
    problem = acyclic(np.random.default_rng(0))
    weights = np.array([1.0, 0.3, 2.0])
    costs = [problem.sums(path) @ weights for path in all_paths(problem, 0)]
    planned = plan(problem, weights)
    path, sums = planned.path(0)
    assert planned.costs[0] == pytest.approx(min(costs))
    assert sums @ weights == pytest.approx(min(costs))
    assert (path[0], path[-1]) == (0, problem.goal)


def test_costs_are_those_of_value_iteration():
    problem = grid(np.random.default_rng(1))
    weights = np.array([1.0, 2.0, 0.5])
    (start, end), costs = problem.edges.T, problem.features @ weights
    values = np.where(np.arange(problem.nodes) == problem.goal, 0.0, np.inf)
    for _ in range(problem.nodes):  # longer than any path
        np.minimum.at(values, start, costs + values[end])
    assert plan(problem, weights).costs == pytest.approx(values)
