"""Adversarial inverse reinforcement learning: Fu, Luo & Levine, ICLR 2018, algorithm 1, with PPO as its policy step."""

from collections.abc import Iterator

from manip_il.algorithms.results import Result
from manip_il.algorithms.run import Run
from manip_il.chapter.discriminators import Discriminator
from manip_il.chapter.learning_config import LearningConfig


def airl(run: Run, c: LearningConfig) -> Iterator[Result]:
    """Yield each iteration's result: roll out the agent, fit f, improve the agent by the reward f - log pi.

    The discriminator is D = exp f / (exp f + pi), with the learner's density pi.
    """
    agent = run.agent()
    d = agent.keep(lambda actor: Discriminator(c.discriminator, actor, c.discount))
    yield from run.begin(agent)
    while agent.simulated < c.steps:
        steps = agent.rollouts()
        agent.discriminate(d, steps)
        agent.improve(d.reward(steps, agent.log_prob(steps)))
        yield run.finish(agent)
