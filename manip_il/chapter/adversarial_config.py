"""Options of PPO and of discriminators; importing them needs neither torch nor stable-baselines3."""

from __future__ import annotations

from dataclasses import dataclass

from manip_il.option import check_bounds, option


@dataclass(frozen=True)
class PPOConfig:
    """Options of PPO, named as in the PPO paper. Raises `UsageError` for a value out of range."""

    lr: float | None = option(
        None,
        "initial learning rate of actor and critic, which falls linearly to a twentieth; by default 5e-4, or 2e-4 "
        "with --init",
        at_least=1e-9,
        at_most=1,
    )
    epochs: int = option(10, "passes over an iteration's steps", at_least=1)
    minibatches: int = option(4, "gradient steps per pass", at_least=1)
    gamma: float | None = option(
        None, "discount per control step; by default 0.9, or 0.97 with --init", at_least=0, at_most=1
    )

    def __post_init__(self) -> None:
        check_bounds(self, "ppo.")

    def first_lr(self, *, clone: bool) -> float:
        """Return the initial learning rate. clone: whether the actor starts from a clone."""
        return self.lr if self.lr is not None else 2e-4 if clone else 5e-4

    def discount(self, *, clone: bool) -> float:
        """Return gamma; by default higher for a clone, as its episodes are long enough to show delayed effects."""
        return self.gamma if self.gamma is not None else 0.97 if clone else 0.9


@dataclass(frozen=True)
class DiscriminatorConfig:
    """Options of a discriminator. Raises `UsageError` for a value out of range."""

    width: int = option(128, "units in each of the two hidden layers", at_least=1)
    lr: float = option(1e-3, "learning rate", at_least=1e-9, at_most=1)
    steps: int = option(10, "gradient steps per iteration", at_least=1)
    batch_size: int = option(256, "transitions of the expert per gradient step, and as many of the learner", at_least=1)
    penalty: float = option(1.0, "weight of the gradient penalty; 0: none", at_least=0)

    def __post_init__(self) -> None:
        check_bounds(self, "discriminator.")
