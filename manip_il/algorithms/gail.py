"""Generative adversarial imitation learning: Ho & Ermon, NeurIPS 2016, algorithm 1, with PPO for the policy's step."""

from collections.abc import Iterator

from manip_il.algorithms.learning_config import LearningConfig
from manip_il.algorithms.learning_run import LearningRun
from manip_il.algorithms.run import Result
from manip_il.learn.discriminators import GailDiscriminator


def gail(run: LearningRun, c: LearningConfig) -> Iterator[Result]:
    """Yield every iteration: roll out the learner, fit the discriminator, improve the learner by its reward."""
    d = run.keep(lambda actor: GailDiscriminator(c.discriminator, actor))
    for i in run.iterations():
        learner = run.rollouts(i)
        run.discriminate(d, learner)
        run.improve(d.reward(learner))
        yield run.finish()
