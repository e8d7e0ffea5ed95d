"""Environments in lockstep: what reaches the robot, when an episode ends, and that it depends on
its seed alone.
"""

import numpy as np
import pytest

from manip_il.chapter.episodes import Lockstep, RobotEpisode
from manip_il.learn.action_spaces import Conversion
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import make_config

from .point import network

ENV = make_config("fetch", "reach")
HAND = Conversion("ee_delta", "fetch")


def up(height: float) -> np.ndarray:
    """A target that raises the hand [m]."""
    target = np.zeros(8, np.float32)
    target[2] = height
    return target


def lockstep(count: int, hold: int | None = 2, horizon: int = 12) -> Lockstep:
    episodes = [RobotEpisode(ENV, hold) for _ in range(count)]
    return Lockstep(episodes, network((1.0,) * 8, (1.0,) * 8), horizon, HAND)


def test_a_target_reaches_the_robot_as_the_joints_it_means():
    ours, env = lockstep(2, hold=None), LadderEnv(ENV)
    observed = ours.start(4)
    env.start(5)
    for step in range(3):
        seen = env.observe()
        assert np.array_equal(
            observed[1, :-2], np.concatenate([seen.state, seen.environment_state])
        )
        action = HAND.decode(up(0.02)[None], seen.state[None])[0].astype(np.float64)
        env.advance(action)
        observed = ours.step(np.stack([up(-0.01), up(0.02)]))
        assert np.array_equal(ours.executed[step][1], action)


def test_an_episode_that_has_ended_leaves_the_others_as_they_are():
    alone, beside = lockstep(1, hold=None), lockstep(3, hold=None)
    alone.start(7)
    beside.start(5)
    middle = beside.episodes[1]
    assert isinstance(middle, RobotEpisode)
    middle._hold, middle._held = 0, 1  # it has ended
    one, three = np.stack([up(0.02)]), np.stack([up(0.03), up(-0.01), up(0.02)])
    for _ in range(2):
        assert np.array_equal(alone.step(one)[0], beside.step(three)[2])
    assert not beside.executed[0][1].any()
    assert beside.simulated == 4


def test_time_is_the_last_number():
    env = lockstep(2, hold=None)
    env.start(1)
    for step in range(1, 13):
        assert env.step(np.zeros((2, 8), np.float32))[:, -1] == pytest.approx(step / 12)
    assert env.simulated == 24
    assert np.concatenate(env.executed).shape == (24, 8)
