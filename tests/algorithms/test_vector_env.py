"""Environments in lockstep: what reaches the robot, when an episode ends, and that it depends on its seed alone."""

from __future__ import annotations

import numpy as np
import pytest

from manip_il.chapter.vector_env import ActionRange, Lockstep, RobotEpisode
from manip_il.learn.action_spaces import Conversion
from manip_il.worlds.ladder.envs import env_of
from manip_il.worlds.table import make_config

ENV = make_config("fetch", "reach")
HAND = Conversion("ee_delta", "fetch")


def up(height: float) -> np.ndarray:
    """A target that raises the hand [m]."""
    target = np.zeros(8, np.float32)
    target[2] = height
    return target


def lockstep(count: int, hold: int | None = 2, horizon: int = 12) -> Lockstep:
    ones = np.ones(8, np.float32)
    episodes = [RobotEpisode(ENV, hold) for _ in range(count)]
    return Lockstep(episodes, ActionRange(0 * ones, ones, -ones, ones), horizon, HAND)


def test_a_target_reaches_the_robot_as_the_joints_it_means():
    ours, env = lockstep(2, hold=None), env_of(ENV)
    ours.seed(4)
    observed = ours.reset()
    env.start(5)
    for step in range(3):
        seen = env.observe()
        assert np.array_equal(observed[1, :-2], np.concatenate([seen.state, seen.environment_state]))
        action = HAND.decode(up(0.02)[None], seen.state[None])[0].astype(np.float64)
        env.advance(action)
        ours.step_async(np.stack([up(-0.01), up(0.02)]))
        observed = np.asarray(ours.step_wait()[0])
        assert np.array_equal(ours.executed[step][1], action)


def test_an_episode_that_has_ended_leaves_the_others_as_they_are():
    alone, beside = lockstep(1, hold=None), lockstep(3, hold=None)
    alone.seed(7)
    beside.seed(5)
    alone.reset()
    beside.reset()
    middle = beside.envs[1].episode
    assert isinstance(middle, RobotEpisode)
    middle._hold, middle._held = 0, 1  # it has ended
    one, three = np.stack([up(0.02)]), np.stack([up(0.03), up(-0.01), up(0.02)])
    for _ in range(2):
        alone.step_async(one)
        beside.step_async(three)
        assert np.array_equal(alone.step_wait()[0][0], beside.step_wait()[0][2])
    assert not beside.executed[0][1].any()
    assert beside.simulated == 4


def test_an_episode_depends_on_its_seed_alone():
    alone, beside = lockstep(1), lockstep(3)
    alone.seed(7)
    beside.seed(5)
    assert np.array_equal(alone.reset()[0], beside.reset()[2])
    for step in range(3):
        action = up(0.01 * step)
        alone.step_async(action[None])
        beside.step_async(np.stack([up(0.03), up(-0.01), action]))
        assert np.array_equal(alone.step_wait()[0][0], beside.step_wait()[0][2])


def test_no_episode_says_that_it_ends_and_time_is_the_last_number():
    env = lockstep(2, hold=None)
    env.seed(1)
    env.reset()
    for step in range(1, 13):
        env.step_async(np.zeros((2, 8), np.float32))
        observations, rewards, dones, _ = env.step_wait()
        assert np.asarray(observations)[:, -1] == pytest.approx(step / 12)
        assert not dones.any()
        assert not rewards.any()
    assert env.simulated == 24
    assert np.concatenate(env.executed).shape == (24, 8)
