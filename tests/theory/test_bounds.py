"""The theorems hold for every policy, and what grows with the horizon grows as they say."""

import itertools

import numpy as np
import pytest

from manip_il.chapter.theory.bounds import (
    PROCESSES,
    RIGHT,
    WRONG,
    Process,
    curves,
    losses_of,
)

FEW = (10, 40, 160)


@pytest.fixture(params=PROCESSES, ids=lambda process: process.name.replace(" ", "_"))
def process(request) -> Process:
    """Each process in turn."""
    return request.param


def small(seed: int = 0) -> Process:
    """A process of three states, whose actions lead evenly to some of them."""
    rng = np.random.default_rng(seed)
    leads = rng.random((2, 3, 3)) < 0.6
    leads[..., 0] = True
    rewards = rng.random((2, 3))
    rewards[WRONG] *= rewards[RIGHT]
    return Process(
        "small",
        "",
        leads / leads.sum(axis=2, keepdims=True),
        rewards,
        np.array([0.5, 0.2, 0.3]),
        (0, 0),
    )


def returns(process: Process, policy: np.ndarray) -> float:
    """The expected sum of rewards of a policy (H, S), over all its paths."""
    horizon, total = len(policy), 0.0
    for states in itertools.product(range(process.states), repeat=horizon):
        for actions in itertools.product((RIGHT, WRONG), repeat=horizon):
            chance, reward = process.start[states[0]], 0.0
            for t, (state, action) in enumerate(zip(states, actions, strict=True)):
                chance *= policy[t, state] if action == WRONG else 1 - policy[t, state]
                reward += process.rewards[action, state]
                chance *= process.moves[action, state, states[t + 1]] if t + 1 < horizon else 1.0
            total += chance * reward
    return total


def test_the_gap_is_the_difference_of_returns_over_all_paths():
    one, rng = small(), np.random.default_rng(1)
    policies = rng.random((3, 4, one.states))
    expert = returns(one, np.zeros((4, one.states)))
    _, gaps, _ = losses_of(one, "DAgger", policies)
    assert gaps == pytest.approx([expert - returns(one, policy) for policy in policies])
    assert one.visits(policies).sum(axis=2) == pytest.approx(np.ones((3, 4)))


def test_trajectories_are_where_the_policy_is_and_the_same_seed_draws_the_same(process):
    policy = np.full((2, 6, process.states), 0.3)
    seen = [
        process.seen(policy, 4_000, [np.random.default_rng(seed) for seed in (5, 6)])
        for _ in range(2)
    ]
    assert (seen[0] == seen[1]).all()
    assert (seen[0] == (process.visits(policy) > 1e-12)).mean() > 0.999


@pytest.mark.slow
def test_slopes_are_the_theorems_and_nothing_is_above_its_bound(process):
    for curve, slope in zip(curves(process, FEW, 12), process.slopes, strict=True):
        assert curve.above == 0
        assert curve.slope == pytest.approx(slope, abs=0.2)


def test_any_policy_keeps_to_both_bounds(process):
    rng = np.random.default_rng(0)
    for horizon in (3, 12):
        wrong = rng.random((20, horizon, process.states)) ** rng.integers(1, 20, (20, 1, 1))
        policies = np.where(process.wrong_costs(horizon) <= 0, 0.0, wrong)
        for learner in ("cloning", "DAgger"):
            _, gaps, bounds = losses_of(process, learner, policies)
            assert (gaps <= bounds + 1e-9).all()


def test_u_is_what_one_wrong_step_costs():
    assert [one.recoverability(50) for one in PROCESSES] == pytest.approx([2, 50, 1])
