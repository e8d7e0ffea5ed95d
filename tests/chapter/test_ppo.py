"""PPO over the mlp's network: the density is the network's, the absorbing state teaches nothing."""

import numpy as np
import torch

from manip_il.chapter.episodes import Transitions
from manip_il.chapter.ppo import seed_generators

from .point import EPISODES, STEPS, learner


def weights(one) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in one.policy.state_dict().items()}


def iterate(one, number: int, actor: bool = True) -> Transitions:
    seed_generators(number)
    rows = one.collect(number * EPISODES)
    one.improve(-np.abs(rows.next_states[:, 0]), actor=actor)
    return rows


def test_the_density_is_that_of_the_policy_network_above_its_mean():
    one = learner()
    rng = np.random.default_rng(1)
    states = np.pad(rng.normal(size=(20, 3)).astype(np.float32), ((0, 0), (0, 1)))
    actions = rng.uniform(-1, 1, (20, 2)).astype(np.float32)
    raw = one.policy.actor.decode_targets(torch.from_numpy(actions))
    with torch.no_grad():
        mean = one.policy.actor.layers(one.policy.actor.encode(torch.from_numpy(states[:, :3])))
        theirs, still = (
            -one.policy.actor.head.nll(mean, one.policy.actor.encode_targets(raw)),
            mean[:, 1],
        )
        spread = one.policy.log_std[0]
        constant = -0.5 * (still / spread.exp()) ** 2 - spread - 0.5 * np.log(2 * np.pi)
    assert len(one.policy.log_std) == 1, "the number that never changes is left out"
    ours = one.log_prob(Transitions(states, actions, states))
    entropy = float(spread) + 0.5 + 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(ours, (theirs - constant).numpy() + entropy, rtol=1e-4, atol=1e-4)


def test_in_the_absorbing_state_every_action_is_as_likely():
    one = learner()
    states = np.zeros((2, 4), np.float32)
    states[:, -1] = 1.0
    assert one.log_prob(
        Transitions(states, np.array([[0, 0], [2, 0]], np.float32), states)
    ).tolist() == [0, 0]


def test_an_episode_that_has_ended_goes_on_in_the_absorbing_state_to_its_last_step():
    one = learner()
    seed_generators(0)
    rows = one.collect(0)
    flags = rows.absorbing.reshape(STEPS, EPISODES)
    assert len(rows) == STEPS * EPISODES
    assert (np.diff(flags.astype(int), axis=0) >= 0).all(), "an absorbing state is never left"
    assert one.env.simulated == (~flags).sum()
    assert not rows.actions[rows.absorbing].any()
    assert not rows.states[rows.absorbing][:, :-1].any()
    after = rows.next_states.reshape(STEPS, EPISODES, -1)
    assert np.array_equal(rows.states.reshape(STEPS, EPISODES, -1)[1:], after[:-1])


def test_it_learns_what_the_reward_asks_for():
    one = learner(ends=False, epochs=10)
    first = np.abs(iterate(one, 0).next_states[:, 0]).mean()
    *_, rows = (iterate(one, number) for number in range(1, 40))
    assert np.abs(rows.next_states[:, 0]).mean() < 0.6 * first


def test_while_the_actor_rests_only_the_critic_learns():
    one = learner()
    before = weights(one)
    iterate(one, 0, actor=False)
    changed = {
        name.split(".")[0]
        for name, value in weights(one).items()
        if not torch.equal(value, before[name])
    }
    assert changed == {"critic"}
    iterate(one, 1)
    assert not torch.equal(
        one.policy.state_dict()["actor.layers.0.weight"], before["actor.layers.0.weight"]
    )
