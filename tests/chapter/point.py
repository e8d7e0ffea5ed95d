"""A point that is to come to a place: an environment of one number, and what a learner on it is
made of.
"""

import numpy as np
import torch

from manip_il.chapter.config import PPOConfig
from manip_il.chapter.episodes import Lockstep
from manip_il.chapter.ppo import Learner, seed_generators
from manip_il.learn.network import MLPNetwork, NetworkConfig

STEPS, EPISODES = 10, 8


class Point:
    """Observes its place x and the goal 0; an action moves it.

    It has ended once it is at the goal.
    """

    def __init__(self, ends: bool = True):
        self.ends, self.x, self.moves = ends, 0.0, 0

    def start(self, seed: int) -> None:
        self.x, self.moves = float(np.random.default_rng(seed).uniform(-2, 2)), 0

    def inputs(self) -> np.ndarray:
        return np.array([self.x, 0.0, 1.0], np.float32)

    def advance(self, action: np.ndarray) -> None:
        self.x, self.moves = self.x + float(action[0]), self.moves + 1

    @property
    def solved(self) -> bool:
        return abs(self.x) < 0.1

    @property
    def ended(self) -> bool:
        return self.ends and self.solved


def network(scale: tuple[float, ...] = (0.5, 0.0), most: tuple[float, ...] = (1, 0)) -> MLPNetwork:
    """An actor on three numbers, whose targets have mean 0, a scale, and a largest size."""
    made = MLPNetwork(
        3,
        len(scale),
        NetworkConfig(width=32, depth=2, loss="gaussian", action_space="joint_target"),
    )
    high = torch.tensor(most, dtype=torch.float32)
    made.set_statistics(
        {"target_scale": torch.tensor(scale), "target_low": -high, "target_high": high}
    )
    return made


def learner(seed: int = 0, ends: bool = True, **options: float) -> Learner:
    """A learner on points, drawn from a seed."""
    seed_generators(seed)
    actor = network()
    env = Lockstep([Point(ends) for _ in range(EPISODES)], actor, STEPS)
    config = PPOConfig(**{"minibatches": 4, **options})
    return Learner(actor, config, env, log_std=-0.5)
