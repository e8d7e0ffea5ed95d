"""Options of a reinforcement learning run, from demonstrations or from a reward."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from manip_il.chapter.adversarial_config import DiscriminatorConfig, PPOConfig
from manip_il.option import Seeded, check_bounds, option
from manip_il.worlds.config import EnvConfig

LONGER = 1.5  # default episode length relative to the longest demonstration


@dataclass(frozen=True, kw_only=True)
class LearningConfig(Seeded):
    """Options of a reinforcement learning run. method: `gail`, `airl` or `ppo`. datasets: demonstrations.

    start, reward: `pretrained_model` folders of the policy to start from and, for `ppo`, of the reward.
    Raises `UsageError` for a number out of range.
    """

    method: str
    env: EnvConfig
    datasets: tuple[Path, ...] = ()
    start: Path | None = None
    reward: Path | None = None
    steps: int = option(200_000, "total number of simulated control steps", at_least=1)
    episodes: int = option(32, "episodes per iteration, run in lockstep", at_least=1)
    episode_steps: int = option(
        0,
        "control steps of an episode while learning; 0: the horizon, or 1.5 times the longest demonstration if shorter",
        at_least=0,
    )
    action_space: str | None = option(
        None, "the policy's actions: ee_delta, joint_delta or joint_target; by default ee_delta, or those of --init"
    )
    log_std: float | None = option(
        None,
        "log of initial action noise in standard deviations of demonstrated actions; by default -0.5, with --init -1",
        at_least=-4,
        at_most=2,
    )
    warmup: int | None = option(
        None, "iterations before the policy is updated; by default 0, or 10 with --init", at_least=0
    )
    ppo: PPOConfig = field(default_factory=PPOConfig)
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    validation_every: int = option(20_000, "control steps between validations", at_least=1)
    validation_episodes: int = option(200, "unseen episodes by which the best policy is chosen", at_least=1)

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def discount(self) -> float:
        """Discount per control step."""
        return self.ppo.discount(clone=self.start is not None)

    @property
    def first_log_std(self) -> float:
        """Log of the initial action noise; smaller for a clone, which should explore close to its own actions."""
        if self.log_std is not None:
            return self.log_std
        return -0.5 if self.start is None else -1.0

    @property
    def warmup_iterations(self) -> int:
        """Iterations that update only the critic, because an untrained critic would ruin a cloned actor."""
        if self.warmup is not None:
            return self.warmup
        return 0 if self.start is None else 10
