"""LeRobot's policies in many episodes at once act in each as LeRobot has them act in one."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from manip_il.learn.policy import LearnedPolicy

from .tiny_policies import observations, write_checkpoint

STEPS = 11
POLICIES = {
    "act": ("act", {}),
    "act, ensembled": ("act", {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1}),
    "diffusion": ("diffusion", {}),
    "diffusion, few steps": (
        "diffusion",
        {"noise_scheduler_type": "DDIM", "num_inference_steps": 3},
    ),
}


@pytest.fixture(params=POLICIES)
def checkpoint(request, spec, tmp_path) -> Path:
    kind, options = POLICIES[request.param]
    return write_checkpoint(tmp_path / "policy", kind, spec, **options)


def actions(policy: LearnedPolicy, starts: dict[int, int]) -> dict[int, np.ndarray]:
    """What a policy does in episodes that begin at their `starts`, (STEPS, n) each."""
    done: dict[int, list[np.ndarray]] = {episode: [] for episode in starts}
    for step in range(STEPS + max(starts.values())):
        running = [episode for episode, start in starts.items() if start <= step < start + STEPS]
        rows = [
            [column[step - starts[episode]] for column in observations(STEPS, episode)]
            for episode in running
        ]
        states, environments = (np.array(column) for column in zip(*rows, strict=True))
        for episode, action in zip(
            running, policy.act(states, environments, None, running), strict=True
        ):
            done[episode].append(action)
    return {episode: np.array(rows) for episode, rows in done.items()}


def lerobots_own(checkpoint: Path, episode: int) -> np.ndarray:
    """LeRobot's loop over one episode, its noise drawn anew from episode and step."""
    policy = get_policy_class(
        json.loads((checkpoint / "config.json").read_text())["type"]
    ).from_pretrained(checkpoint)
    before, after = make_pre_post_processors(policy.config, str(checkpoint))
    policy.reset()
    done = []
    for step, (state, environment) in enumerate(zip(*observations(STEPS, episode), strict=True)):
        batch = {"observation.state": torch.from_numpy(state[None]), "task": ["reach"]}
        batch["observation.environment_state"] = torch.from_numpy(environment[None])
        with torch.random.fork_rng(devices=[]), torch.inference_mode():
            torch.manual_seed(
                int(np.random.SeedSequence([episode, step]).generate_state(1, np.uint64)[0])
            )
            done.append(after(policy.select_action(before(batch))).numpy()[0])
    return np.array(done, np.float64)


def test_an_episode_is_lerobots_own_loop_whatever_runs_beside_it(checkpoint, request):
    alone, own = actions(LearnedPolicy.load(checkpoint), {7: 0})[7], lerobots_own(checkpoint, 7)
    if "diffusion" in request.node.name:  # plans in blocks of rows, rounded otherwise than one row
        np.testing.assert_allclose(alone, own, atol=1e-5)
    else:
        assert np.array_equal(alone, own)
    beside = actions(LearnedPolicy.load(checkpoint), {5: 0, 6: 1, 7: 2, 8: 4, 23: 1, 39: 2, 55: 2})
    assert np.array_equal(beside[7], alone)  # 23, 39 and 55 have its row of a block
    assert not np.array_equal(beside[8], alone)


def test_an_episode_that_is_left_out_or_reset_begins_anew(act):
    policy = LearnedPolicy.load(act)
    states, environments = observations(STEPS, 0)
    one, two = (states[:1], environments[:1]), (states[1:2], environments[1:2])
    first = policy.act(*one, None, [0])
    assert not np.array_equal(policy.act(*one, None, [0]), first)  # the second action of the chunk
    policy.act(*two, None, [1])  # without 0, which has ended
    assert np.array_equal(policy.act(*one, None, [0]), first)
    policy.begin({0: ""})
    assert np.array_equal(policy.act(*one, None, [0]), first)
    assert policy.act(np.empty((0, 4)), np.empty((0, 6))).shape == (0, 4)


def test_draws_belong_to_the_episode_and_leave_the_global_generator_alone(spec, tmp_path):
    policy = LearnedPolicy.load(write_checkpoint(tmp_path / "policy", "diffusion", spec))
    state, environment = (np.repeat(column[:1], 2, axis=0) for column in observations(STEPS, 0))
    generator = torch.get_rng_state()
    left, right = policy.act(state, environment, None, [1, 2])
    assert torch.equal(torch.get_rng_state(), generator)
    assert not np.array_equal(left, right)
    torch.manual_seed(5)
    policy.begin({1: ""})
    assert np.array_equal(policy.act(state[:1], environment[:1], None, [1])[0], left)


def test_the_task_in_words_reaches_the_policy(act, monkeypatch):
    tasks = []

    def select_action(_, batch) -> torch.Tensor:
        tasks.append(batch["task"])
        return torch.zeros(1, 4)

    monkeypatch.setattr("lerobot.policies.act.modeling_act.ACTPolicy.select_action", select_action)
    policy = LearnedPolicy.load(act, task="put it there")
    policy.act(*observations(STEPS, 0))
    assert tasks == [["put it there"]] * STEPS
    policy.begin({1: "no, here"})
    policy.act(*observations(2, 0))
    assert tasks[STEPS:] == [["put it there"], ["no, here"]]
