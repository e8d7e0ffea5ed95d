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
    dagger_bound,
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


def visited_by_walking(process: Process, policy: np.ndarray, count: int, rng) -> np.ndarray:
    """Which states of each step `count` trajectories of a policy (H, S) visit, step by step."""
    found = np.zeros(policy.shape, bool)
    for _ in range(count):
        state = rng.choice(process.states, p=process.start)
        for t in range(len(policy)):
            found[t, state] = True
            action = WRONG if rng.random() < policy[t, state] else RIGHT
            state = rng.choice(process.states, p=process.moves[action, state])
    return found


def test_states_are_seen_as_often_as_trajectories_visit_them():
    one, rng, count, times = small(), np.random.default_rng(2), 3, 2_000
    policy = rng.random((4, one.states))
    drawn = one.seen(np.broadcast_to(policy, (times, *policy.shape)), count, rng)
    walked = [visited_by_walking(one, policy, count, rng) for _ in range(times)]
    assert drawn.mean(axis=0) == pytest.approx(np.mean(walked, axis=0), abs=0.06)


def test_only_states_that_the_policy_reaches_are_seen_and_the_same_seed_draws_the_same(process):
    policy = np.full((2, 6, process.states), 0.3)
    seen, again = (process.seen(policy, 4_000, np.random.default_rng(5)) for _ in range(2))
    assert (seen == again).all()
    assert (seen == (process.visits(policy) > 1e-12)).mean() > 0.999


@pytest.mark.slow
def test_slopes_are_the_theorems_and_nothing_is_above_its_bound(process):
    for curve, slope in zip(curves(process, FEW, 12), process.slopes, strict=True):
        assert curve.above == 0
        assert curve.slope == pytest.approx(slope, abs=0.2)


def random_process(rng: np.random.Generator) -> Process:
    """A process of 2 to 5 states with any rewards, whose expert need not be optimal."""
    states = rng.integers(2, 6)
    moves = rng.dirichlet(np.full(states, 0.3), (2, states))
    first = rng.dirichlet(np.ones(states))
    return Process("random", "", moves, rng.random((2, states)), first, (0, 0))


@pytest.fixture(scope="module")
def random_processes() -> list[tuple[Process, np.ndarray]]:
    """300 random processes, each with 20 random deterministic policies over 2 to 12 steps."""
    rng, found = np.random.default_rng(0), []
    for _ in range(300):
        one = random_process(rng)
        shape = (20, int(rng.integers(2, 13)), one.states)
        found.append((one, (rng.random(shape) < rng.random((20, 1, 1))).astype(float)))
    return found


def test_the_theorem_on_cloning_holds_in_300_random_processes(random_processes):
    for one, policies in random_processes:
        _, gaps, bounds = losses_of(one, "cloning", policies)
        assert (np.abs(gaps) <= bounds + 1e-9).all()


def test_errors_in_own_states_cost_at_most_u_each_in_300_random_processes(random_processes):
    better = 0
    for one, policies in random_processes:
        errors, gaps, bounds = losses_of(one, "DAgger", policies)
        horizon = policies.shape[1]
        assert (gaps <= bounds + 1e-9).all()
        largest = np.abs(one.wrong_costs(horizon)).max()
        assert (np.abs(gaps) <= dagger_bound(horizon, errors, largest) + 1e-9).all()
        better += bool((np.abs(gaps) > bounds + 1e-9).any())
    assert better > 0  # u does not limit how much better a policy is than the expert


def test_without_u_the_theorem_on_dagger_holds_where_no_action_costs_more_than_one(
    random_processes,
):
    cheap = 0
    for one, policies in random_processes:
        horizon = policies.shape[1]
        if np.abs(one.wrong_costs(horizon)).max() <= 1:
            errors, gaps, _ = losses_of(one, "DAgger", policies)
            assert (np.abs(gaps) <= dagger_bound(horizon, errors, 1.0) + 1e-9).all()
            cheap += 1
    assert cheap > 100


def test_without_u_it_fails_on_a_tightrope():
    tightrope, horizon = PROCESSES[1], 40
    policies = np.full((1, horizon, tightrope.states), 0.001)
    errors, gaps, _ = losses_of(tightrope, "DAgger", policies)
    assert (gaps > 10 * horizon * errors).all()


@pytest.mark.parametrize("learner", ["cloning", "DAgger"])
def test_both_bounds_are_reached_by_errors_in_the_first_step_of_a_tightrope(learner):
    tightrope = PROCESSES[1]
    policies = np.zeros((1, 40, tightrope.states))
    policies[:, 0] = 0.01
    _, gaps, bounds = losses_of(tightrope, learner, policies)
    assert gaps == pytest.approx(bounds)
    assert gaps > 0


def values(process: Process, policy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V (H + 1, S) and Q (2, H, S) of a policy, from the last step to the first."""
    horizon = len(policy)
    value, quality = np.zeros((horizon + 1, process.states)), np.zeros((2, *policy.shape))
    for t in range(horizon - 1, -1, -1):
        quality[:, t] = process.rewards + process.moves @ value[t + 1]
        value[t] = (1 - policy[t]) * quality[RIGHT, t] + policy[t] * quality[WRONG, t]
    return value, quality


def test_the_gap_is_the_policys_advantages_along_the_experts_episodes(random_processes):
    for one, policies in random_processes[::10]:
        _, gaps, _ = losses_of(one, "DAgger", policies)
        expert = np.zeros(policies.shape[1:])
        for policy, gap in zip(policies, gaps, strict=True):
            value, quality = values(one, policy)
            advantages = quality[RIGHT] - value[:-1]
            assert (one.visits(expert) * advantages).sum() == pytest.approx(gap, abs=1e-9)


def test_u_is_what_one_wrong_step_costs():
    assert [one.recoverability(50) for one in PROCESSES] == pytest.approx([2, 50, 1])
