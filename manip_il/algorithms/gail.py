"""Generative adversarial imitation learning: Ho & Ermon, NeurIPS 2016, algorithm 1, with PPO for the policy's step."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from manip_il.learn.discriminators import GailDiscriminator

if TYPE_CHECKING:
    from manip_il.algorithms.iterations import Iteration
    from manip_il.algorithms.learning_config import LearningConfig
    from manip_il.algorithms.learning_run import LearningRun


def gail(run: LearningRun, c: LearningConfig) -> Iterator[Iteration]:
    """Yield every iteration: roll out the learner, tell it from the expert, improve it where it is taken for him."""
    d = run.keep(lambda actor: GailDiscriminator(c.discriminator, actor, c.reward_form))
    for i in run.iterations():
        learner = run.rollouts(i)
        run.discriminate(d, learner)
        run.improve(d.reward(learner))
        yield run.finish()
