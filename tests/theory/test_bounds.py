"""The theorems hold for every policy, and what grows with the horizon grows as they say."""

import numpy as np
import pytest

from manip_il.theory.bounds import clone, cloning_loss, constructed, curves, dagger, dagger_loss
from manip_il.theory.problems import PROBLEMS, RIGHT, WRONG, expert_visits, recoverability, wrong_costs

FEW = (10, 40, 160)


@pytest.fixture(params=PROBLEMS, ids=lambda problem: problem.name.replace(" ", "_"))
def problem(request):
    """Each process in turn."""
    return request.param


@pytest.mark.slow
def test_slopes_are_the_theorems_and_nothing_is_above_its_bound(problem):
    found = {(curve.learner, curve.fit): curve for curve in curves(problem, FEW, 12)}
    assert sum(curve.above for curve in found.values()) == 0
    for learner, slope in zip(("cloning", "DAgger"), problem.slopes, strict=True):
        assert found[learner, "worst"].slope == pytest.approx(slope, abs=0.2)
        assert found[learner, "constructed"].slope == pytest.approx(slope, abs=0.06)
        low, high = found[learner, "worst"].interval
        assert low <= found[learner, "worst"].slope <= high
        assert high - low < 0.4


def test_any_policy_keeps_to_both_bounds(problem):
    rng = np.random.default_rng(0)
    for horizon in (3, 12):
        for _ in range(20):
            wrong = rng.random((horizon, problem.mdp.states)) ** rng.integers(1, 20)
            policy = np.stack([1 - wrong, wrong], axis=2)
            policy[wrong_costs(problem, horizon) <= 0] = [1.0, 0.0]
            assert not cloning_loss(problem, policy).above
            assert not dagger_loss(problem, policy).above


def test_a_policy_that_errs_with_a_probability_loses_what_dynamic_programming_says(problem):
    horizon, error = 8, 0.01
    policy = constructed(problem, horizon, error, off_data=False)
    visits = problem.mdp.visits(policy)
    loss = dagger_loss(problem, policy)
    by_hand = (visits * policy[..., WRONG] * wrong_costs(problem, horizon)).sum()
    assert loss.gap == pytest.approx(by_hand)  # the performance difference lemma
    assert loss.error == pytest.approx((visits * policy[..., WRONG]).sum() / horizon)


def test_u_is_what_one_wrong_step_costs():
    walk, rope, chain = PROBLEMS
    assert [recoverability(one, 50) for one in (walk, rope, chain)] == pytest.approx([2, 50, 1])


def test_a_clone_does_as_the_expert_where_it_has_data_and_the_worst_elsewhere(problem):
    horizon = 6
    seen = np.random.default_rng(0).random((horizon, problem.mdp.states)) < 0.5
    costly = wrong_costs(problem, horizon) > 0
    worst, even = (clone(problem, seen, fit) for fit in ("worst", "even"))
    assert (worst[seen, RIGHT] == 1).all()
    assert (worst[~seen & costly, WRONG] == 1).all()
    assert (even[~seen & costly, WRONG] == 0.5).all()
    assert (worst[~costly, RIGHT] == 1).all()


def test_all_data_leave_no_error_and_dagger_finds_what_the_expert_never_shows():
    walk, horizon = PROBLEMS[0], 12
    everywhere = np.ones((horizon, walk.mdp.states), np.bool_)
    assert cloning_loss(walk, clone(walk, everywhere, "worst")).gap == 0
    shown = expert_visits(walk, horizon) > 0
    shown[:, :20] = False  # a fifth of the places is not in the demonstrations
    before = dagger_loss(walk, clone(walk, shown, "worst"))
    after = dagger_loss(walk, dagger(walk, shown, "worst", 300, np.random.default_rng(0)))
    assert after.gap < 0.05 * before.gap
