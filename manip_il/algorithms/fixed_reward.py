"""Reinforcement learning from a reward that is given, on the same run as the adversarial algorithms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from manip_il.algorithms.iterations import Iteration
    from manip_il.algorithms.learning_run import LearningRun
    from manip_il.learn.reward import LearnedReward


def reinforcement(run: LearningRun, reward: LearnedReward) -> Iterator[Iteration]:
    """Yield every iteration: roll out the learner, improve it by the reward. The run's episodes must have no hold."""
    for i in run.iterations():
        run.rollouts(i)
        run.improve(reward(*run.executed()))
        yield run.finish()
