"""The distribution over all paths is what listing them, a linear system, and sampling from it say."""

import numpy as np
import pytest
from scipy.special import logsumexp

from manip_il.errors import ManipError
from manip_il.rewards.max_entropy import soft_plan
from manip_il.rewards.paths import PathProblem
from tests.rewards.grids import acyclic, all_paths, draw, grid

WEIGHTS = np.array([1.0, 0.3, 2.0])


def test_values_and_features_are_sums_over_all_paths():
    problem = acyclic(np.random.default_rng(0))
    paths, planned = all_paths(problem, 0), soft_plan(problem, WEIGHTS)
    costs = np.array([problem.sums(path) @ WEIGHTS for path in paths])
    chances = np.exp(-costs) / np.exp(-costs).sum()
    assert planned.values[0] == pytest.approx(-logsumexp(-costs))
    assert planned.features(0) == pytest.approx(chances @ [problem.sums(path) for path in paths])


def test_on_a_graph_with_circles_it_solves_the_linear_system():
    problem = grid(np.random.default_rng(1))
    weights = 3 * WEIGHTS
    planned, shares = soft_plan(problem, weights), np.exp(-problem.costs(weights))
    shares[problem.edges[:, 0] == problem.goal] = 0
    matrix = problem.matrix(shares).toarray()
    assert np.abs(np.linalg.eigvals(matrix)).max() < 1
    sums = np.linalg.solve(np.eye(problem.nodes) - matrix, np.eye(problem.nodes)[problem.goal])
    assert planned.values == pytest.approx(-np.log(sums), rel=1e-10)


def test_who_leaves_a_node_takes_one_of_its_edges_and_arrives_once():
    problem = grid(np.random.default_rng(2))
    planned = soft_plan(problem, 3 * WEIGHTS)
    leaves = np.bincount(problem.edges[:, 0], planned.chances, problem.nodes)
    assert leaves == pytest.approx(1.0 - np.eye(problem.nodes)[problem.goal], abs=1e-12)
    visits = planned.visits(0)
    flow = np.bincount(problem.edges[:, 1], visits, problem.nodes) - np.bincount(problem.edges[:, 0], visits)
    assert flow == pytest.approx(np.eye(problem.nodes)[problem.goal] - np.eye(problem.nodes)[0], abs=1e-11)


def test_drawn_paths_have_the_expected_features():
    problem, rng = grid(np.random.default_rng(3)), np.random.default_rng(0)
    planned = soft_plan(problem, 3 * WEIGHTS)
    drawn = np.array([problem.sums(draw(planned, 0, rng)) for _ in range(2_000)])
    assert drawn.mean(axis=0) == pytest.approx(planned.features(0), abs=4 * drawn.std(axis=0).max() / np.sqrt(2_000))


def test_where_no_path_leads_values_are_infinite():
    problem = PathProblem(np.array([[0, 1], [2, 0], [0, 3]]), np.ones((3, 1)), 4, 1)
    planned = soft_plan(problem, np.ones(1))
    assert list(planned.values) == pytest.approx([1, 0, 2, np.inf])
    assert list(planned.chances) == [1, 1, 0]
    with pytest.raises(ManipError, match="no path leads from node 3"):
        planned.features(3)
