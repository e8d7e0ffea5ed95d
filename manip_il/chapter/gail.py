"""Generative adversarial imitation learning: Ho & Ermon, NeurIPS 2016, algorithm 1, with PPO as its policy step."""

from collections.abc import Iterator

from manip_il.algorithms.results import Result
from manip_il.algorithms.run import Run
from manip_il.chapter.discriminators import Discriminator
from manip_il.chapter.learning_config import LearningConfig


def gail(run: Run, c: LearningConfig) -> Iterator[Result]:
    """Yield each iteration's result: roll out the agent, fit the discriminator, use its reward to improve the agent."""
    agent = run.agent()
    d = agent.keep(lambda actor: Discriminator(c.discriminator, actor))
    yield from run.begin(agent)
    while agent.simulated < c.steps:
        steps = agent.rollouts()
        agent.discriminate(d, steps)
        agent.improve(d.reward(steps))
        yield run.finish(agent)
