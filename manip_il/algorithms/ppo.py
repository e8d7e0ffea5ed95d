"""Reinforcement learning by PPO from a reward that is given (Schulman et al. 2017)."""

from collections.abc import Iterator

from manip_il.algorithms.learning_run import Iteration, LearningRun
from manip_il.learn.reward import LearnedReward


def ppo(run: LearningRun, reward: LearnedReward) -> Iterator[Iteration]:
    """Yield every iteration: roll out the learner, improve it by the reward. The run's episodes must have no hold."""
    for i in run.iterations():
        run.rollouts(i)
        run.improve(reward(*run.executed()))
        yield run.finish()
