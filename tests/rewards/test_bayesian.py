"""The posterior: chains draw from the density they are given, and it knows what the
demonstrations leave open.
"""

import numpy as np
import pytest

from manip_il.chapter.rewards.bayesian import Choices, draw_posterior, fit
from manip_il.tasks.carry.grid import Demonstration, PathProblem, open_features, rivals
from tests.rewards.grids import acyclic, all_paths, demonstrations, excess

TRUTH = np.array([1.0, 4.0, 2.0])
SIZE = {"shape": (9, 8)}
PRIOR = 3.0


def small_choices(rng: np.random.Generator) -> np.ndarray:
    """Feature sums of all paths through a small random process, (m, K)."""
    problem = acyclic(rng)
    return np.array([problem.sums(path) for path in all_paths(problem, 0)])


def choose(sums: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same sums (m, K) with one first that is drawn with probability proportional to
    exp(-cost).
    """
    chances = np.exp((sums @ weights).min() - sums @ weights)
    one = int(rng.choice(len(sums), p=chances / chances.sum()))
    return np.concatenate([sums[[one]], np.delete(sums, one, axis=0)])


def test_the_likelihood_is_of_one_choice_among_all_paths():
    rng = np.random.default_rng(0)
    sums = [small_choices(rng) for _ in range(3)]
    weights = rng.random((2, 3))
    expected = [sum(-one[0] @ w - np.log(np.exp(-one @ w).sum()) for one in sums) for w in weights]
    assert Choices.of(sums).log_likelihood(weights) == pytest.approx(expected)


def test_many_choices_leave_the_weights_that_made_them():
    rng = np.random.default_rng(0)
    sums = [choose(small_choices(rng), TRUTH, rng) for _ in range(600)]
    found = draw_posterior(Choices.of(sums), rng, PRIOR)
    assert found.mean(axis=0) == pytest.approx(TRUTH, rel=0.25)
    low, high = np.quantile(found / found[:, [0]], [0.05, 0.95], axis=0)
    assert ((low <= TRUTH) & (high >= TRUTH)).all()


def test_what_is_learnt_plans_as_the_demonstrator_on_unseen_grids():
    found = fit(demonstrations(15, TRUTH, **SIZE), np.random.default_rng(0))
    assert excess(found.mean(axis=0), TRUTH, **SIZE) < 0.01


def test_a_feature_in_which_all_agree_is_open_and_keeps_its_prior():
    shown = []
    for one in demonstrations(4, TRUTH[:2], things=1):
        features = np.column_stack([one.problem.features, np.zeros(len(one.problem.edges))])
        problem = PathProblem(one.problem.edges, features, one.problem.nodes, one.problem.goal)
        shown.append(Demonstration(problem, one.path))
    rng = np.random.default_rng(0)
    found = rivals(shown, rng.exponential(PRIOR, (20, 3)))
    assert open_features(shown, found) == [2]
    draws = draw_posterior(Choices.of(found), rng, PRIOR)
    assert draws[:, 2].mean() == pytest.approx(PRIOR, rel=0.15)
