"""Reinforcement learning by PPO with a given reward (Schulman et al. 2017)."""

from collections.abc import Callable, Iterator
from pathlib import Path

from manip_il.algorithms.results import Result
from manip_il.algorithms.run import Run
from manip_il.chapter.learning_config import LearningConfig
from manip_il.chapter.reward import LearnedReward
from manip_il.chapter.transitions import F32


def ppo(run: Run, c: LearningConfig, reward: Callable[..., F32] | None = None) -> Iterator[Result]:
    """Yield each iteration's result: roll out the agent and improve it with `reward`.

    reward: maps joint states (N, n), environment states (N, k) and absolute actions (N, n) to rewards (N,); by default
    the reward in the folder `c.reward`.
    """
    reward = reward or LearnedReward.load(c.reward or Path())
    agent = run.agent()
    yield from run.begin(agent)
    while agent.simulated < c.steps:
        agent.rollouts()
        agent.improve(reward(*agent.executed()))
        yield run.finish(agent)
