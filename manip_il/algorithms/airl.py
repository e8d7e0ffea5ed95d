"""Adversarial inverse reinforcement learning: Fu, Luo & Levine, ICLR 2018, algorithm 1, with PPO for its last step."""

from collections.abc import Iterator

from manip_il.algorithms.learning_config import LearningConfig
from manip_il.algorithms.learning_run import LearningRun
from manip_il.algorithms.run import Result
from manip_il.learn.discriminators import AirlDiscriminator


def airl(run: LearningRun, c: LearningConfig) -> Iterator[Result]:
    """Yield every iteration: roll out the learner, fit f by D = exp f / (exp f + pi), improve it by f - log pi."""
    d = run.keep(lambda actor: AirlDiscriminator(c.discriminator, actor, c.discount))
    for i in run.iterations():
        learner = run.rollouts(i)
        run.discriminate(d, learner)
        run.improve(d.reward(learner, run.log_prob(learner)))
        yield run.finish()
