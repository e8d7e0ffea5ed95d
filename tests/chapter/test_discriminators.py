"""Discriminators: they learn who acted, their rewards prefer the expert, and the penalty bounds
them.
"""

from typing import Any

import numpy as np
import pytest
import torch

from manip_il.chapter.config import DiscriminatorConfig
from manip_il.chapter.discriminators import LARGEST_REWARD, Discriminator
from manip_il.chapter.episodes import Transitions
from manip_il.chapter.ppo import seed_generators

from .point import network

N = 400


def rows(action: float, seed: int = 0) -> Transitions:
    """Steps of somebody whose actions are about `action`."""
    rng = np.random.default_rng(seed)
    states = np.pad(rng.normal(size=(N, 3)), ((0, 0), (0, 1))).astype(np.float32)
    actions = np.stack([rng.normal(action, 0.3, N), np.zeros(N)], axis=1).astype(np.float32)
    return Transitions(states, actions, states + 0.1 * np.float32([1, 0, 0, 0]))


def log_density(steps: Transitions, mean: float) -> np.ndarray:
    return (
        -0.5 * ((steps.actions[:, 0] - mean) / 0.3) ** 2 - np.log(0.3 * np.sqrt(2 * np.pi))
    ).astype(np.float32)


def make(kind: str, **options):
    seed_generators(0)
    config = DiscriminatorConfig(**{"width": 32, "steps": 200, **options})
    return Discriminator(config, network(), None if kind == "gail" else 0.9)


def trained(kind: str, **options):
    d, expert, learner = make(kind, **options), rows(0.5), rows(-0.5, seed=1)
    logs = log_density(expert, -0.5), log_density(learner, -0.5)
    d.fit(expert, learner, logs, np.random.default_rng(0))
    return d, d.fit(expert, learner, logs, np.random.default_rng(1))


@pytest.mark.parametrize("kind", ["gail", "airl"])
def test_it_learns_who_acted(kind):
    _, found = trained(kind)
    assert found["accuracy_expert"] > 0.85
    assert found["accuracy_learner"] > 0.85


def test_the_reward_prefers_the_expert():
    d, _ = trained("gail")
    logs = np.zeros(N, np.float32)
    expert, learner = (d.reward(rows(action, seed=7), logs).mean() for action in (0.5, -0.5))
    assert expert > 0 > learner


def test_the_reward_of_airl_is_f_less_the_log_density():
    d: Any = trained("airl")[0]
    steps = rows(0.0, seed=3)
    logs = log_density(steps, 0.0)
    with torch.no_grad():
        states, actions, after, _ = d._encode(steps, logs)
        f = d.g(torch.cat([states, actions], 1)) + 0.9 * d.h(after) - d.h(states)
    expected = (f.squeeze(1).numpy() - logs).clip(-LARGEST_REWARD, LARGEST_REWARD)
    np.testing.assert_allclose(d.reward(steps, logs), expected, rtol=1e-5, atol=1e-5)


def test_the_reward_that_airl_keeps_is_g_of_raw_inputs():
    d: Any = trained("airl", state_only=True)[0]
    steps, actor = rows(0.0, seed=3), network()
    kept = d.learned(actor, steps.states)
    with torch.no_grad():
        [g] = d.g.members(d._encode(steps, np.zeros(N, np.float32))[0])
        [r] = kept.members(torch.from_numpy(steps.states[:, :-1]))
        scaled = kept(torch.from_numpy(steps.states[:, :-1]))
    assert torch.equal(g, r)
    assert torch.quantile(scaled, torch.tensor([0.01, 0.99])).tolist() == pytest.approx(
        [0, 1], abs=1e-4
    )


def test_the_penalty_holds_the_slope_near_one():
    slopes = []
    for penalty in (0.0, 10.0):
        d, _ = trained("gail", penalty=penalty)
        states, actions, after, log_prob = d._encode(rows(0.0), np.zeros(N, np.float32))
        actions.requires_grad_()
        [slope] = torch.autograd.grad(d.logits((states, actions, after, log_prob)).sum(), [actions])
        slopes.append(slope.norm(dim=1).mean().item())
    assert slopes[0] > 1.5
    assert slopes[1] < 1.2
