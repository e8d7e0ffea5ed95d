"""The distribution over all paths, and the cheapest of them, are what listing them says."""

import numpy as np
import pytest
from scipy.special import logsumexp

from manip_il.chapter.rewards.max_entropy import soft_plan
from manip_il.tasks.carry.grid import plan
from tests.rewards.grids import acyclic, all_paths

WEIGHTS = np.array([1.0, 0.3, 2.0])


def test_values_features_and_the_cheapest_path_are_those_of_all_paths():
    problem = acyclic(np.random.default_rng(0))
    paths, planned = all_paths(problem, 0), soft_plan(problem, WEIGHTS)
    costs = np.array([problem.sums(path) @ WEIGHTS for path in paths])
    chances = np.exp(-costs) / np.exp(-costs).sum()
    assert planned.values[0] == pytest.approx(-logsumexp(-costs))
    assert planned.features(0) == pytest.approx(chances @ [problem.sums(path) for path in paths])
    cheapest = plan(problem, WEIGHTS)
    path, sums = cheapest.path(0)
    assert cheapest.costs[0] == pytest.approx(costs.min())
    assert sums @ WEIGHTS == pytest.approx(costs.min())
    assert (path[0], path[-1]) == (0, problem.goal)
