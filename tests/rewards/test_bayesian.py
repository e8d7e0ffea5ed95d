"""The posterior: chains draw from the density they are given, and it knows what the demonstrations leave open."""

import numpy as np
import pytest

from manip_il.errors import ManipError
from manip_il.rewards.bayesian import Choices, draw_posterior, fit
from manip_il.rewards.calibration import calibrate, choose, small_choices
from manip_il.rewards.demonstrations import Demonstration, add_rivals, open_features, rivals
from manip_il.rewards.mcmc import agreement, effective_size, sample
from manip_il.rewards.paths import PathProblem
from tests.rewards.grids import demonstrations, excess

TRUTH = np.array([1.0, 4.0, 2.0])
SIZE = {"shape": (9, 8)}


def test_chains_have_the_moments_of_the_density():
    mean, covariance = np.array([1.0, -2.0]), np.array([[1.0, 0.8], [0.8, 2.0]])
    inverse = np.linalg.inv(covariance)
    draws = sample(
        lambda points: -0.5 * np.einsum("ci,ij,cj->c", points - mean, inverse, points - mean),
        np.zeros((4, 2)),
        5_000,
        1_000,
        np.random.default_rng(0),
    )
    assert draws.pooled.mean(axis=0) == pytest.approx(mean, abs=0.15)
    assert np.cov(draws.pooled.T) == pytest.approx(covariance, rel=0.15)
    assert 0.15 < draws.accepted < 0.4
    assert (agreement(draws.points) < 1.02).all()


def test_the_effective_size_is_that_of_an_autoregression():
    rng, rho = np.random.default_rng(0), 0.9
    points = np.zeros((4, 20_000, 1))
    for t in range(1, points.shape[1]):
        points[:, t] = rho * points[:, t - 1] + rng.standard_normal((4, 1))
    assert effective_size(points)[0] == pytest.approx(80_000 * (1 - rho) / (1 + rho), rel=0.15)
    assert effective_size(rng.standard_normal((4, 5_000, 1)))[0] == pytest.approx(20_000, rel=0.1)


def test_chains_that_disagree_are_seen():
    points = np.random.default_rng(0).standard_normal((4, 1_000, 1)) + np.arange(4)[:, None, None]
    assert agreement(points)[0] > 1.5
    assert effective_size(points)[0] < 50


def test_a_chain_starts_where_there_is_something():
    with pytest.raises(ManipError, match="density is 0"):
        sample(lambda points: np.full(len(points), -np.inf), np.zeros((2, 1)), 1, 1, np.random.default_rng(0))


def test_the_likelihood_is_of_one_choice_among_all_paths():
    rng = np.random.default_rng(0)
    sums = [small_choices(rng) for _ in range(3)]
    weights = rng.random((2, 3))
    expected = [sum(-one[0] @ w - np.log(np.exp(-one @ w).sum()) for one in sums) for w in weights]
    assert Choices.of(sums).log_likelihood(weights) == pytest.approx(expected)


def test_many_choices_leave_the_weights_that_made_them():
    rng = np.random.default_rng(0)
    sums = [choose(small_choices(rng), TRUTH, rng) for _ in range(600)]
    found = draw_posterior(Choices.of(sums), rng, 3.0)
    assert found.mean == pytest.approx(TRUTH, rel=0.25)
    assert (found.effective > 200).all()
    low, high = found.ratios(0).T
    assert ((low <= TRUTH) & (high >= TRUTH)).all()


def test_what_is_learnt_plans_as_the_demonstrator_on_unseen_grids():
    found, _ = fit(demonstrations(15, TRUTH, **SIZE), np.random.default_rng(0))
    assert excess(found.mean, TRUTH, **SIZE) < 0.01
    low, high = found.ratios(0).T
    assert ((low <= TRUTH) & (high >= TRUTH)).all()


def test_rivals_are_paths_other_than_the_demonstration_each_once():
    shown, rng = demonstrations(8, TRUTH, **SIZE), np.random.default_rng(0)
    found = rivals(shown, rng.exponential(3.0, (30, 3)))
    again = add_rivals(shown, found, np.array([TRUTH]))
    assert max(map(len, found)) > 2
    for one, sums, more in zip(shown, found, again, strict=True):
        assert sums[0] == pytest.approx(one.sums)
        assert len(np.unique(sums.round(6), axis=0)) == len(sums)
        assert len(more) == len(sums)  # the demonstration is what its own taste finds


def with_nothing(problem: PathProblem) -> PathProblem:
    """The same with one feature more, 0 everywhere."""
    features = np.column_stack([problem.features, np.zeros(len(problem.edges))])
    return PathProblem(problem.edges, features, problem.nodes, problem.goal)


def test_a_feature_in_which_all_agree_is_open():
    shown = demonstrations(4, TRUTH[:2], things=1)
    without = [Demonstration(with_nothing(one.problem), one.path) for one in shown]
    rng = np.random.default_rng(0)
    found = rivals(without, rng.exponential(3.0, (20, 3)))
    assert open_features(without, found) == [2]
    posterior = draw_posterior(Choices.of(found), rng, 3.0).draws.pooled[:, 2]
    assert posterior.mean() == pytest.approx(3.0, rel=0.15)  # as the prior has it


@pytest.mark.slow
def test_ranks_are_uniform_and_intervals_cover():
    found = calibrate(np.random.default_rng(0))
    assert found.p_value > 0.05
    assert 0.85 <= found.covered <= 0.95
