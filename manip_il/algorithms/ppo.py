"""Reinforcement learning by PPO from a reward that is given (Schulman et al. 2017)."""

from collections.abc import Callable, Iterator
from pathlib import Path

from manip_il.algorithms.learning_config import LearningConfig
from manip_il.algorithms.learning_run import LearningRun
from manip_il.algorithms.run import Result
from manip_il.learn.reward import LearnedReward
from manip_il.learn.transitions import F32


def ppo(run: LearningRun, c: LearningConfig, reward: Callable[..., F32] | None = None) -> Iterator[Result]:
    """Yield every iteration: roll out the learner, improve it by the reward, by default that in `c.reward`.

    reward: of joint states (N, n), environment states (N, k) and absolute actions (N, n), (N,).
    """
    reward = reward or LearnedReward.load(c.reward or Path())
    for i in run.iterations():
        run.rollouts(i)
        run.improve(reward(*run.executed()))
        yield run.finish()
