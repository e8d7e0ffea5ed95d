"""Cheapest paths are those that dynamic programming and listing all paths find."""

import numpy as np
import pytest

from manip_il.errors import ManipError, MismatchError
from manip_il.rewards.calibration import all_paths
from manip_il.rewards.paths import NOWHERE, PathProblem, cheapest_path, costs_to_go, plan
from tests.rewards.grids import acyclic, grid


def test_the_cheapest_path_is_the_best_of_all():
    problem = acyclic(np.random.default_rng(0))
    weights = np.array([1.0, 0.3, 2.0])
    costs = [problem.sums(path) @ weights for path in all_paths(problem, 0)]
    planned = plan(problem, weights)
    path, sums = cheapest_path(problem, planned, 0)
    assert planned.costs[0] == pytest.approx(min(costs))
    assert sums @ weights == pytest.approx(min(costs))
    assert (path[0], path[-1]) == (0, problem.goal)


def test_costs_are_those_of_dynamic_programming():
    problem = grid(np.random.default_rng(1))
    weights = np.array([1.0, 2.0, 0.5])
    mdp = problem.to_mdp(weights, 0)
    values, stay = np.zeros(problem.nodes), np.arange(problem.nodes) == problem.goal
    for _ in range(problem.nodes):  # longer than any path
        values = mdp.action_values(np.where(stay, 0, values)).max(axis=1)
    assert costs_to_go(problem, weights) == pytest.approx(-values)


def test_a_path_over_edges_that_cost_nothing_ends():
    problem = grid(np.random.default_rng(2))
    planned = plan(problem, np.zeros(3))
    assert not planned.costs.any()
    assert cheapest_path(problem, planned, 0)[0][-1] == problem.goal


def test_edges_of_no_cost_are_edges():
    edges = np.array([[0, 1], [1, 2], [0, 2]])
    problem = PathProblem(edges, np.array([[0.0], [0.0], [1.0]]), 3, 2)
    assert list(cheapest_path(problem, plan(problem, np.ones(1)), 0)[0]) == [0, 1, 2]


def test_where_no_path_leads_costs_are_infinite():
    problem = PathProblem(np.array([[0, 1], [2, 0]]), np.ones((2, 1)), 4, 1)
    planned = plan(problem, np.ones(1))
    assert list(planned.costs) == [1, 0, 2, np.inf]
    assert list(planned.following) == [1, NOWHERE, 0, NOWHERE]
    with pytest.raises(ManipError, match="no path leads from node 3"):
        cheapest_path(problem, planned, 3)


def test_a_path_off_the_edges_is_refused():
    problem = PathProblem(np.array([[0, 1], [1, 2]]), np.ones((2, 1)), 3, 2)
    with pytest.raises(ManipError, match="no edge"):
        problem.sums(np.array([0, 2]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"edges": np.array([[0, 1], [1, 3]])}, "0 to 2"),
        ({"edges": np.array([[0, 1], [1, 1]])}, "to itself"),
        ({"edges": np.array([[0, 1], [0, 1]])}, "same nodes"),
        ({"goal": 3}, "0 to 2"),
        ({"features": np.array([[1.0], [-1.0]])}, "negative"),
        ({"features": np.array([[1.0], [np.nan]])}, "not finite"),
        ({"features": np.ones((3, 1))}, "the features"),
    ],
)
def test_what_is_no_problem_is_refused(change, words):
    parts = {"edges": np.array([[0, 1], [1, 2]]), "features": np.ones((2, 1)), "nodes": 3, "goal": 2}
    with pytest.raises(ManipError, match=words):
        PathProblem(**parts | change)


def test_weights_that_do_not_fit_are_refused():
    problem = PathProblem(np.array([[0, 1]]), np.ones((1, 1)), 2, 1)
    with pytest.raises(MismatchError, match="weights"):
        plan(problem, np.ones(2))
    with pytest.raises(ManipError, match="expected 0 or more"):
        plan(problem, -np.ones(1))
