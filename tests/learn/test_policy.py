"""Acting: through LeRobot and past it the same; a row does not feel its company."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import make_pre_post_processors

from manip_il.errors import MismatchError, UsageError
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.losses import LOSSES
from manip_il.learn.mlp import MLPPolicy
from manip_il.learn.network import threads
from manip_il.learn.policy import LearnedPolicy
from manip_il.learn.train import Trainer

from .tiny_policies import observations


@pytest.fixture
def checkpoint(dataset, tmp_path):
    return make_checkpoint(dataset, tmp_path)


def make_checkpoint(dataset, folder, loss="mse"):
    return Trainer(dataset, FitConfig({"loss": loss}, steps=3, batch_size=32), folder / loss).fit()


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("count", [1, 2])
def test_a_row_does_not_depend_on_the_others(loss, count, dataset, tmp_path):
    path = make_checkpoint(dataset, tmp_path, loss)
    assert LearnedPolicy.load(path).act(*observations(0)).shape == (0, 4)
    policy = MLPPolicy.from_pretrained(path)
    inputs = torch.from_numpy(np.concatenate(observations(130), axis=1))
    with threads(count):
        together = policy.model.act(inputs)
        for rows in (
            [0],
            [77],
            [129, 3],
            list(range(64)),
            list(range(129, 40, -1)),
            list(range(5, 130)),
        ):
            assert torch.equal(policy.model.act(inputs[rows]), together[rows])


def test_acting_is_the_same_through_lerobots_processors(checkpoint):
    states, environments = observations(7)
    policy = MLPPolicy.from_pretrained(checkpoint)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    for row in range(7):  # unbatched, as a robot gives them
        batch = {
            "observation.state": torch.from_numpy(states[row]),
            "observation.environment_state": torch.from_numpy(environments[row]),
        }
        action = after(policy.select_action(before(batch)))
        fast = LearnedPolicy.load(checkpoint).act(
            states[row : row + 1], environments[row : row + 1]
        )
        assert fast.dtype == np.float64
        assert np.array_equal(action.numpy().astype(np.float64), fast)


def test_off_the_data_an_arm_target_stays_as_near_as_in_the_data(checkpoint, table):
    states, environments = observations(50)
    actions = LearnedPolicy.load(checkpoint).act(states * 1e3, environments * 1e6)
    relative = table["action"][:, :-1] - table["observation.state"][:, :-1]
    scale = np.abs(states).max() * 1e3
    assert (
        np.abs(actions[:, :-1] - states[:, :-1] * 1e3).max()
        <= np.abs(relative).max() + 1e-6 * scale
    )


def test_pictures_go_in_as_lerobot_feeds_them():
    class Seen:
        def select(self, batch, episodes):
            self.batch, self.episodes = batch, list(episodes)
            return torch.zeros(2, 4)

    inner = Seen()
    numbers, pictures = {"observation.state": 4}, {"front": (5, 6)}
    policy = LearnedPolicy(
        inner, Checkpoint(Path("x"), {"type": "act"}, numbers, pictures, 4, "", "", (), None, {})
    )
    picture = np.arange(2 * 5 * 6 * 3, dtype=np.uint8).reshape(2, 5, 6, 3)
    states, environments = observations(2)
    policy.act(states, environments, {"front": picture, "wrist": picture}, [40, 30])
    theirs = preprocess_observation({"pixels": {"front": picture}, "agent_pos": states})
    assert inner.batch.keys() == theirs.keys()
    assert all(torch.equal(inner.batch[key], theirs[key]) for key in theirs)
    assert inner.batch["observation.images.front"].is_contiguous()
    assert inner.episodes == [40, 30]
    for wrong in ({"wrist": picture}, {"front": picture.transpose(0, 2, 1, 3)}):
        with pytest.raises(MismatchError, match=r"pictures of front.*\(5, 6\)"):
            policy.act(states, environments, wrong)


def test_offsets_are_seen_at_several_scales_and_nothing_else_is(write, table, spec, tmp_path):
    names = ("ee.x", "goal_from_object.x", "goal_from_object.y", "e3", "e4", "e5")
    data = write(table, spec=replace(spec, environment_state_names=names))
    path = Trainer(
        data,
        FitConfig({"scales": [0.003, 0.03], "width": 16}, steps=3, batch_size=32),
        tmp_path / "run",
    ).fit()
    policy, states, environments = LearnedPolicy.load(path), *observations(70)
    network: Any = policy.module
    assert network.scaled == [5, 6]
    raw = torch.from_numpy(np.concatenate([states, environments], axis=1))
    assert torch.equal(network.expanded(raw)[:, 12:], torch.tanh(raw[:, [5, 6]] / 0.03))
    actions = policy.act(states, environments)
    assert np.array_equal(policy.act(states[7:9], environments[7:9]), actions[7:9])
    assert np.array_equal(
        MLPPolicy.from_pretrained(path).model.act(raw).numpy().astype(np.float64), actions
    )
    with pytest.raises(UsageError, match="scales needs offsets"):
        Trainer(write(table, "other"), FitConfig({"scales": [0.003]}), tmp_path / "other_run").fit()
