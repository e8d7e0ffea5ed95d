"""Options of GAIL, AIRL and PPO; importing them needs neither torch nor stable-baselines3."""

from dataclasses import dataclass, field
from pathlib import Path

from manip_il.errors import UsageError
from manip_il.option import Seeded, check_bounds, option
from manip_il.worlds.config import EnvConfig

LONGER = 1.5  # default episode length relative to the longest demonstration


@dataclass(frozen=True)
class PPOConfig:
    """Options of PPO, named as in the PPO paper. Raises `UsageError` for a value out of range."""

    lr: float | None = option(
        None,
        "initial learning rate of actor and critic, which falls linearly to a twentieth; by default"
        " 5e-4, or 2e-4 with --init",
        at_least=1e-9,
        at_most=1,
    )
    epochs: int = option(10, "passes over an iteration's steps", at_least=1)
    minibatches: int = option(4, "gradient steps per pass", at_least=1)
    gamma: float | None = option(
        None,
        "discount per control step; by default 0.9, or 0.97 with --init",
        at_least=0,
        at_most=1,
    )

    def __post_init__(self) -> None:
        check_bounds(self, "ppo.")

    def first_lr(self, *, clone: bool) -> float:
        """Return the initial learning rate.

        Args:
            clone: Whether the actor starts from a clone.
        """
        return self.lr if self.lr is not None else 2e-4 if clone else 5e-4

    def discount(self, *, clone: bool) -> float:
        """Return gamma.

        By default it is higher for a clone, as its episodes are long enough to show delayed
        effects.

        Args:
            clone: Whether the actor starts from a clone.
        """
        return self.gamma if self.gamma is not None else 0.97 if clone else 0.9


@dataclass(frozen=True)
class DiscriminatorConfig:
    """Options of a discriminator. Raises `UsageError` for a value out of range."""

    width: int = option(128, "units in each of the two hidden layers", at_least=1)
    lr: float = option(1e-3, "learning rate", at_least=1e-9, at_most=1)
    steps: int = option(10, "gradient steps per iteration", at_least=1)
    batch_size: int = option(
        256, "transitions of the expert per gradient step, and as many of the learner", at_least=1
    )
    penalty: float = option(1.0, "weight of the gradient penalty; 0: none", at_least=0)
    state_only: bool = option(
        False, "rl airl: a reward of the state alone, which is written to OUTPUT_DIR/reward"
    )

    def __post_init__(self) -> None:
        check_bounds(self, "discriminator.")


@dataclass(frozen=True, kw_only=True)
class LearningConfig(Seeded):
    """Options of a reinforcement learning run.

    Attributes:
        method: `gail`, `airl` or `ppo`.
        env: The environment.
        datasets: Folders of the demonstrations.
        start: `pretrained_model` folder of the policy to start from, if any.
        reward: `pretrained_model` folder of the reward, for `ppo`.

    Raises:
        UsageError: If a number is out of range.
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
        "control steps of an episode while learning; 0: the horizon, or 1.5 times the longest"
        " demonstration if shorter",
        at_least=0,
    )
    action_space: str | None = option(
        None,
        "the policy's actions: ee_delta, joint_delta or joint_target; by default ee_delta, or those"
        " of --init",
    )
    log_std: float | None = option(
        None,
        "log of initial action noise in standard deviations of demonstrated actions; by default"
        " -0.5, with --init -1",
        at_least=-4,
        at_most=2,
    )
    warmup: int | None = option(
        None, "iterations before the policy is updated; by default 0, or 10 with --init", at_least=0
    )
    ppo: PPOConfig = field(default_factory=PPOConfig)
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    validation_every: int = option(20_000, "control steps between validations", at_least=1)
    validation_episodes: int = option(
        200, "unseen episodes by which the best policy is chosen", at_least=1
    )

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.discriminator.state_only and self.method != "airl":
            raise UsageError(
                f"discriminator.state_only is true for {self.method}; expected false, as only AIRL"
                " learns a reward"
            )

    @property
    def discount(self) -> float:
        """Discount per control step."""
        return self.ppo.discount(clone=self.start is not None)

    @property
    def first_log_std(self) -> float:
        """Log of the initial action noise.

        Smaller for a clone, which should explore close to its own actions.
        """
        if self.log_std is not None:
            return self.log_std
        return -0.5 if self.start is None else -1.0

    @property
    def warmup_iterations(self) -> int:
        """Iterations that update only the critic, because an untrained critic would ruin a
        cloned actor.
        """
        if self.warmup is not None:
            return self.warmup
        return 0 if self.start is None else 10
