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
from manip_il.collect.environments import env_fingerprint, env_spec, policy_cameras
from manip_il.collect.job import RolloutJob, observed_cameras
from manip_il.collect.workers import Engine
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.runner import evaluate
from manip_il.learn.checkpoint import Origin
from manip_il.seeding import stream_seeds
from manip_il.sim.config import CameraConfig, Look
from manip_il.sim.env import EnvConfig, ManipEnv

from ..learn.tiny_policies import edit_config, write_checkpoint

SEEDS = stream_seeds("certificate", 4)
ENV = EnvConfig("panda", "reach", horizon=8)
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
    env = ManipEnv.of(ENV, cameras)
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


def test_a_rollout_is_lerobots_own_loop_to_the_bit(act):
    job = RolloutJob(ENV, PolicyDriver((act,)), label="last")
    for episode in job.run(SEEDS[:2]):
        assert np.array_equal(episode.columns["executed_action"], lerobots_rollout(act, episode.seed))


@pytest.mark.gl
def test_a_policy_sees_the_pictures_that_lerobot_would_show_it(seeing):
    [episode] = RolloutJob(ENV, PolicyDriver((seeing,)), label="last").run(SEEDS[:1])
    assert np.array_equal(episode.columns["executed_action"], lerobots_rollout(seeing, SEEDS[0], DIM))
    bright = lerobots_rollout(seeing, SEEDS[0], replace(DIM, look=Look()))
    assert not np.array_equal(episode.columns["executed_action"], bright)


@pytest.mark.gl
def test_pictures_are_kept_where_they_are_recorded_and_only_there(seeing, tmp_path):
    job = RolloutJob(ENV, PolicyDriver((seeing,), 0.5))
    keep = Journal(tmp_path, env_spec(ENV), env_fingerprint(ENV))
    episodes = list(Engine(1).run(job, SEEDS[:2], keep))
    assert not [key for episode in episodes for key in episode.columns if key.startswith("observation.images")]
    assert [read_journal(path)[1].seed for path in list_episodes(tmp_path)] == list(SEEDS[:2])
    both = replace(DIM, names=("wrist", "front"))
    recorded = list(replace(job, cameras=both).run(SEEDS[:2]))
    assert recorded[0].columns["observation.images.wrist"].shape == (8, 32, 32, 3)
    assert written(episode.without_pictures() for episode in recorded) == written(episodes)


@pytest.mark.gl
def test_an_evaluation_says_which_pictures_it_was_made_with(seeing):
    result = evaluate(Engine(1), RolloutJob(ENV, PolicyDriver((seeing,)), label="last"), SEEDS[:1], "seeing")
    assert result.fingerprint == env_fingerprint(ENV, DIM)
    assert result.fingerprint != env_fingerprint(ENV, replace(DIM, look=Look()))


def test_a_checkpoint_says_what_it_must_be_shown(act, seeing, tmp_path):
    assert policy_cameras(act) is None
    assert policy_cameras(seeing) == DIM
    spec = env_spec(ENV, CameraConfig(("wrist", "front"), 32, 64))
    other = write_checkpoint(tmp_path / "other", "act", spec, "both")  # as lerobot-train leaves it
    assert policy_cameras(other) == CameraConfig(("wrist", "front"), 32, 64)


def test_what_is_recorded_must_hold_what_the_policy_looks_at(act, seeing):
    job = RolloutJob(ENV, PolicyDriver((seeing,)))
    assert observed_cameras(job) == DIM
    wide = CameraConfig(("wrist", "front"), 32, 32)
    assert observed_cameras(replace(job, cameras=wide)) == wide
    assert observed_cameras(replace(job, driver=PolicyDriver((act,)))) is None
    for cameras, words in ((replace(wide, names=("wrist",)), "cameras"), (replace(wide, width=64), "size of pictures")):
        with pytest.raises(MismatchError, match=rf"{words} differs"):
            list(replace(job, cameras=cameras).run(SEEDS[:1]))


def test_pictures_that_no_environment_has_are_refused(seeing, tmp_path):
    folder = write_checkpoint(tmp_path / "p", "act", env_spec(ENV, DIM), "images")
    features = {"observation.state": {"type": "STATE", "shape": [8]}}

    def look_at(**pictures: list[int]) -> None:
        visual = {f"observation.images.{name}": {"type": "VISUAL", "shape": shape} for name, shape in pictures.items()}
        edit_config(folder, input_features=features | visual)

    for pictures, kind, words in (
        ({"top": [3, 32, 32]}, MismatchError, r"cameras .*top, the environment has front, side, wrist"),
        ({"front": [3, 32, 32], "wrist": [3, 64, 64]}, MismatchError, "one size for all"),
        ({"front": [3, 33, 32]}, ManipError, "height 33"),
    ):
        look_at(**pictures)
        with pytest.raises(kind, match=words):
            policy_cameras(folder)


def test_a_policy_for_another_robot_is_refused_before_the_first_step(act, monkeypatch):
    monkeypatch.setattr(ManipEnv, "advance", None)
    with pytest.raises(MismatchError, match=r"width of observation\.environment_state"):
        list(RolloutJob(EnvConfig("fetch", "lift"), PolicyDriver((act,))).run(SEEDS[:1]))
