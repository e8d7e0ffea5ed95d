"""Errors are counted by Eq. 8.5: per episode, over the horizon, however early an episode ends; and
the bounds are those of the theorems for these errors.
"""

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from manip_il.chapter.theory import shift
from manip_il.collect.drivers import RandomDriver
from manip_il.data import schema
from manip_il.mdp import Episode
from manip_il.worlds.table import described_env, make_config

ENV = replace(make_config("panda", "reach"), horizon=80)
EXPERTS, OWN = 20, 80  # steps of an episode
EPISODES = 2


class Rollouts:
    """Runs no world: the expert solves each episode, the policy none, and errs in each other
    step.
    """

    def __init__(self, scale: np.ndarray):
        self.scale = scale

    def run(self, job, seeds):
        """Yield an episode per seed."""
        solved = job.driver != RandomDriver()
        length = EXPERTS if solved else OWN
        label = np.zeros((length, len(self.scale)))
        executed = label.copy()
        if not solved:
            executed[::2, 0] = self.scale[0]
        columns = {
            schema.STATE: label,
            schema.ENVIRONMENT_STATE: label,
            schema.ACTION: label,
            schema.EXECUTED_ACTION: executed,
            schema.LABEL_VALID: np.ones((length, 1)),
        }
        for seed in seeds:
            yield Episode(seed, columns, solved, solved)


@pytest.fixture(scope="module")
def measured() -> shift.Shift:
    """A policy that errs in the first action of each of the expert's episodes."""
    scale = described_env(ENV).actions.scale
    first = np.zeros(len(scale))
    first[1] = -scale[1]

    steps = itertools.count()  # actions are asked for step by step

    def act(state, environment_state, options, episodes):
        return np.zeros(state.shape) + first * (next(steps) == 0)

    policy = SimpleNamespace(cameras=(), act=act)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shift, "LearnedPolicy", SimpleNamespace(load=lambda path: policy))
        patch.setattr(shift, "PolicyDriver", SimpleNamespace(of=lambda path: RandomDriver()))
        return shift.measure_shift(Rollouts(scale), ENV, [(0, Path())], u=3, episodes=EPISODES)


def test_errors_are_wrong_steps_of_an_episode_over_the_horizon(measured):
    [found] = measured.rounds
    assert found.errors == pytest.approx((1 / 80, 40 / 80))
    assert found.shares == pytest.approx((1 / EXPERTS, 0.5))


def test_gap_and_bounds_are_in_control_steps_and_of_the_same_errors(measured):
    [found] = measured.rounds
    assert found.gap == 80 - EXPERTS
    assert found.bounds == pytest.approx((80**2 * found.errors[0], 3 * 80 * found.errors[1]))
