"""DART: demonstrations under noise that resembles the learner's errors (Laskey et al., CoRL
2017).
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.results import Result
from manip_il.algorithms.run import Run
from manip_il.collect.drivers import NoisyExpertDriver
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE
from manip_il.errors import ManipError
from manip_il.learn.policy import LearnedPolicy, actions_along


def dart(run: Run, c: RunConfig) -> Iterator[Result]:
    """Yield each round's result: demonstrate under noise like the learner's errors, aggregate,
    refit, validate.
    """
    data = [run.demonstrations(c.demonstrations)]
    policy = run.fit(data)
    yield run.validate(policy)
    for i in range(1, c.rounds + 1):
        noise = fitted_noise(policy.path, run.held_out(), trust=c.fit.trust)
        data.append(run.rollouts(i, NoisyExpertDriver(noise)))
        policy = run.fit(data)
        yield run.validate(policy)


def fitted_noise(policy: Path, root: Path, *, trust: bool = False) -> tuple[tuple[float, ...], ...]:
    """Return the covariance of the learner's errors on an expert's dataset: the next round's noise.

    It is the maximum likelihood fit of a Gaussian with mean zero, as in the paper.

    Args:
        policy: The `pretrained_model` folder of the learner.
        root: The expert's dataset. The policy must not have been fitted to it, or its errors are
            underestimated.
        trust: Whether to load models that the checkpoint names, see `LearnedPolicy.load`.

    Returns:
        The covariance (n, n), in the squared units of the action.

    Raises:
        ManipError: The dataset has no valid label, or the policy cannot be loaded.
    """
    dataset = Dataset.open(root)
    table = dataset.columns((STATE, ENVIRONMENT_STATE, ACTION, LABEL_VALID, EPISODE_INDEX))
    learner, valid = LearnedPolicy.load(policy, trust=trust), table[LABEL_VALID].reshape(-1) != 0
    episodes = dataset.episodes
    texts = zip(episodes.index.tolist(), episodes.tasks, strict=True)
    learner.begin({episode: text for episode, (text, *_) in texts})
    errors = [
        (actions - table[ACTION][rows])[valid[rows]]
        for rows, actions in actions_along(learner, table)
    ]
    off = np.concatenate(errors)
    if not len(off):
        raise ManipError(f"{root} has no valid label to compare the policy with")
    return tuple(map(tuple, (off.T @ off / len(off)).tolist()))
