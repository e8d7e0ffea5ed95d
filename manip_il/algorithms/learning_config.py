"""The options of a run of reinforcement learning, from demonstrations or from a reward."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from manip_il.learn.adversarial_config import DiscriminatorConfig, PPOConfig
from manip_il.option import Seeded, check_bounds, option
from manip_il.tasks.config import EnvConfig

LONGER = 1.5  # times the longest demonstration, by default


@dataclass(frozen=True, kw_only=True)
class LearningConfig(Seeded):
    """Options of a run of reinforcement learning. method: `gail`, `airl` or `ppo`. datasets: demonstrations.

    start, reward: `pretrained_model` folders of a clone, and of the reward that `ppo` learns from.
    Raises `UsageError` for a number out of range.
    """

    method: str
    env: EnvConfig
    datasets: tuple[Path, ...] = ()
    start: Path | None = None
    reward: Path | None = None
    steps: int = option(200_000, "simulated control steps in all", at_least=1)
    episodes: int = option(32, "of an iteration, side by side", at_least=1)
    episode_steps: int = option(
        0,
        "control steps of an episode while learning; 0: 1.5 times the longest demonstration's, or the horizon",
        at_least=0,
    )
    action_space: str | None = option(
        None, "what the policy's actions are: ee_delta, joint_delta or joint_target; by default ee_delta, or --init's"
    )
    log_std: float | None = option(
        None,
        "log of the first spread of actions, in deviations of the demonstrations'; by default -0.5, or -1 of a clone",
        at_least=-4,
        at_most=2,
    )
    warmup: int | None = option(
        None, "iterations in which critic and discriminator learn alone; by default 0, or 10 with --init", at_least=0
    )
    ppo: PPOConfig = field(default_factory=PPOConfig)
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    validation_every: int = option(20_000, "steps from one validation to the next", at_least=1)
    validation_episodes: int = option(200, "episodes of a validation, by which the best policy is chosen", at_least=1)

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def discount(self) -> float:
        """Discount of a control step."""
        return self.ppo.discount(clone=self.start is not None)

    @property
    def first_log_std(self) -> float:
        """Log of the first spread of actions; of a clone small, so that it explores close to what it does."""
        if self.log_std is not None:
            return self.log_std
        return -0.5 if self.start is None else -1.0

    @property
    def warmup_iterations(self) -> int:
        """Iterations before the actor moves: a critic that knows nothing destroys a clone."""
        if self.warmup is not None:
            return self.warmup
        return 0 if self.start is None else 10
