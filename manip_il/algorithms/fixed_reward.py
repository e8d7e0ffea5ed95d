"""Reinforcement learning from a reward that is given, on the same run as the adversarial algorithms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from manip_il.mdp import F32, F64

if TYPE_CHECKING:
    from manip_il.algorithms.learning_run import Iteration, LearningRun


class Reward(Protocol):
    """A reward of control steps, as a dataset has them."""

    def __call__(
        self, states: F32, environment_states: F32, actions: F64, next_states: F32, next_environment_states: F32
    ) -> F32:
        """Return rewards (B,) of joint states (B, n), environment states (B, k), absolute actions (B, n), and after."""
        ...


def reinforcement(run: LearningRun, reward: Reward) -> Iterator[Iteration]:
    """Yield every iteration: roll out the learner, improve it by the reward. The run's episodes must have no hold."""
    for i in run.iterations():
        run.rollouts(i)
        run.improve(reward(*run.executed()))
        yield run.finish()
