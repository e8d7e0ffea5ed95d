"""The distribution over all paths is what listing them, a linear system, and sampling from it
say.
"""

import numpy as np
import pytest
from scipy.special import logsumexp

from manip_il.chapter.rewards.max_entropy import soft_plan
from tests.rewards.grids import acyclic, all_paths, draw, grid

WEIGHTS = np.array([1.0, 0.3, 2.0])


def test_values_and_features_are_sums_over_all_paths():
    problem = acyclic(np.random.default_rng(0))
    paths, planned = all_paths(problem, 0), soft_plan(problem, WEIGHTS)
    costs = np.array([problem.sums(path) @ WEIGHTS for path in paths])
    chances = np.exp(-costs) / np.exp(-costs).sum()
    assert planned.values[0] == pytest.approx(-logsumexp(-costs))
    assert planned.features(0) == pytest.approx(chances @ [problem.sums(path) for path in paths])


def test_drawn_paths_have_the_expected_features():
    problem, rng = grid(np.random.default_rng(3)), np.random.default_rng(0)
    planned = soft_plan(problem, 3 * WEIGHTS)
    drawn = np.array([problem.sums(draw(planned, 0, rng)) for _ in range(2_000)])
    assert drawn.mean(axis=0) == pytest.approx(
        planned.features(0), abs=4 * drawn.std(axis=0).max() / np.sqrt(2_000)
    )
