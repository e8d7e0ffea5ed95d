"""LeRobot's policies in our rollouts: LeRobot's own actions, pictures where they look, and the same everywhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kept import written
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.learn.checkpoint import Origin
from manip_il.seeding import stream_seeds
from manip_il.sim.config import CameraConfig, Look
from manip_il.tasks.config import make_config
from manip_il.tasks.envs import env_of

from ..learn.tiny_policies import write_checkpoint

SEEDS = stream_seeds("certificate", 4)
ENV = make_config("panda", "reach", horizon=8)
DIM = CameraConfig(("front",), 32, 32, Look(brightness=0.5))


@pytest.fixture(scope="module")
def act(tmp_path_factory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("act"), "act", env_spec(ENV))


@pytest.fixture(scope="module")
def seeing(tmp_path_factory) -> Path:
    """A policy of the front camera, in dim light."""
    spec = env_spec(ENV, DIM)
    meta = Origin.of(spec, env_fingerprint(ENV, DIM), observation="images", look={"brightness": 0.5})
    return write_checkpoint(tmp_path_factory.mktemp("seeing"), "act", spec, "images", origin=meta)


def lerobots_rollout(checkpoint: Path, seed: int, cameras: CameraConfig | None = None) -> np.ndarray:
    """Actions of LeRobot's own evaluation loop over one environment, (T, n)."""
    policy = ACTPolicy.from_pretrained(checkpoint)
    before, after = make_pre_post_processors(policy.config, str(checkpoint))
    env = env_of(ENV, cameras)
    policy.reset()
    observation, _ = env.reset(seed=seed)
    actions, over = [], False
    while not over:
        batch = preprocess_observation(observation) | {"task": [env.task_description]}
        with torch.inference_mode():
            action = after(policy.select_action(before(batch))).numpy()
        actions.append(action[0])
        observation, _, _, over, _ = env.step(action[0])
    return np.array(actions)


@pytest.mark.parametrize(("name", "cameras"), [("act", None), pytest.param("seeing", DIM, marks=pytest.mark.gl)])
def test_a_rollout_is_lerobots_own_loop_to_the_bit(name, cameras, request):
    policy = request.getfixturevalue(name)
    for episode in RolloutJob(ENV, PolicyDriver((policy,)), label="last").run(SEEDS[:2]):
        assert np.array_equal(episode.columns["executed_action"], lerobots_rollout(policy, episode.seed, cameras))
        if cameras:
            bright = lerobots_rollout(policy, episode.seed, replace(cameras, look=Look()))
            assert not np.array_equal(episode.columns["executed_action"], bright)


@pytest.mark.gl
def test_pictures_are_kept_where_they_are_recorded_and_only_there(seeing):
    job = RolloutJob(ENV, PolicyDriver((seeing,), 0.5))
    episodes = list(job.run(SEEDS[:2]))
    assert not [key for episode in episodes for key in episode.columns if key.startswith("observation.images")]
    recorded = list(replace(job, cameras=replace(DIM, names=("wrist", "front"))).run(SEEDS[:2]))
    assert recorded[0].columns["observation.images.wrist"].shape == (8, 32, 32, 3)
    assert written(episode.without_pictures() for episode in recorded) == written(episodes)
