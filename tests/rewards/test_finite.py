"""Finite processes: values are what summing over all paths gives, and sampled trajectories have the exact visits."""

import itertools

import numpy as np
import pytest
from scipy.sparse import csr_array

from manip_il.errors import ManipError, MismatchError
from manip_il.rewards.finite import FiniteMDP, Trajectories, deterministic


def drawn(states: int = 4, actions: int = 3, seed: int = 0) -> FiniteMDP:
    """A process of random numbers."""
    rng = np.random.default_rng(seed)
    moves, start = rng.random((states, actions, states)), rng.random(states)
    moves[rng.random(moves.shape) < 0.4] = 0
    moves[..., 0] += 0.1
    return FiniteMDP.of(
        moves / moves.sum(axis=2, keepdims=True), rng.normal(size=(states, actions)), start / start.sum()
    )


def policy_of(mdp: FiniteMDP, horizon: int) -> np.ndarray:
    chances = np.random.default_rng(1).random((horizon, *mdp.rewards.shape))
    return chances / chances.sum(axis=2, keepdims=True)


def test_worth_is_the_sum_over_all_paths():
    mdp, horizon = drawn(3, 2), 3
    policy, moves = policy_of(mdp, 3), mdp.transitions.toarray().reshape(3, 2, 3)
    total = 0.0
    for states in itertools.product(range(3), repeat=horizon + 1):
        for actions in itertools.product(range(2), repeat=horizon):
            chance, worth = mdp.start[states[0]], 0.0
            for t, action in enumerate(actions):
                chance *= policy[t, states[t], action] * moves[states[t], action, states[t + 1]]
                worth += mdp.rewards[states[t], action]
            total += chance * worth
    assert mdp.worth(policy) == pytest.approx(total, rel=1e-12)


def test_a_plan_is_the_best_of_all_deterministic_policies():
    mdp = drawn(2, 2)
    best = max(
        mdp.worth(deterministic(np.array(actions).reshape(3, 2), 2))
        for actions in itertools.product(range(2), repeat=6)
    )
    assert mdp.worth(deterministic(mdp.plan(3), 2)) == pytest.approx(best)


def test_visits_are_distributions_and_give_the_worth():
    mdp = drawn()
    policy = policy_of(mdp, 6)
    visits = mdp.visits(policy)
    assert visits.sum(axis=1) == pytest.approx(np.ones(6))
    assert (visits[:, :, None] * policy * mdp.rewards).sum() == pytest.approx(mdp.worth(policy))


def test_gaps_of_the_policy_itself_average_to_nothing():
    mdp = drawn()
    policy = policy_of(mdp, 5)
    assert (policy * mdp.gaps(policy)).sum(axis=2) == pytest.approx(np.zeros((5, 4)), abs=1e-12)


def test_sampled_trajectories_have_the_exact_visits_and_the_same_seed_the_same_ones():
    mdp = drawn()
    policy, count = policy_of(mdp, 5), 20_000
    states = Trajectories(mdp).states(policy, count, np.random.default_rng(0))
    shares = np.stack([np.bincount(row, minlength=4) for row in states]) / count
    assert shares == pytest.approx(mdp.visits(policy), abs=0.02)
    assert np.array_equal(states, Trajectories(mdp).states(policy, count, np.random.default_rng(0)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rewards": np.full((2, 2), np.nan)}, "not finite"),
        ({"start": np.array([0.5, 0.6])}, "no distributions"),
        ({"transitions": csr_array(np.full((4, 2), 0.4))}, "no distributions"),
        ({"transitions": csr_array(np.tile([1.5, -0.5], (4, 1)))}, "no distributions"),
    ],
)
def test_what_is_no_process_is_refused(change, words):
    parts = {"transitions": csr_array(np.full((4, 2), 0.5)), "rewards": np.zeros((2, 2)), "start": np.array([1.0, 0.0])}
    with pytest.raises(ManipError, match=words):
        FiniteMDP(**parts | change)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(MismatchError, match="transitions"):
        FiniteMDP(csr_array(np.full((4, 2), 0.5)), np.zeros((3, 2)), np.array([1.0, 0.0, 0.0]))
    with pytest.raises(MismatchError, match="start"):
        FiniteMDP(csr_array(np.full((4, 2), 0.5)), np.zeros((2, 2)), np.array([1.0]))
