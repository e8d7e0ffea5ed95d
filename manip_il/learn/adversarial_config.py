"""Options of PPO and of discriminators, without what they are made of."""

from __future__ import annotations

import math
from dataclasses import dataclass

from manip_il.errors import UsageError
from manip_il.option import option


@dataclass(frozen=True)
class PPOConfig:
    """Options of PPO, by its paper's names. Raises `UsageError` for a value out of range."""

    lr: float | None = option(
        None,
        "first learning rate of actor and critic, falls linearly to a twentieth over the run; by default 5e-4, or 2e-4 "
        "of a clone",
    )
    epochs: int = option(10, "passes over an iteration's steps")
    minibatches: int = option(4, "gradient steps in one pass")
    gamma: float | None = option(None, "discount of a control step; by default 0.9, or 0.97 of a clone")
    gae_lambda: float = option(0.95, "of generalised advantage estimation")
    clip_range: float = option(0.2, "of the ratio of densities")
    entropy: float = option(0.0, "weight of the entropy")
    target_kl: float = option(0.05, "an iteration's passes end once the actor has moved 1.5 times as far [nats]")

    def __post_init__(self) -> None:
        for name, low, high in (("lr", 0.0, 1.0), ("clip_range", 0.0, 1.0), ("target_kl", 0.0, math.inf)):
            if (value := getattr(self, name)) is not None and not low < value < high:
                raise UsageError(f"ppo.{name} is {value}; expected more than {low:g}, less than {high:g}")
        for name in ("gamma", "gae_lambda"):
            if (value := getattr(self, name)) is not None and not 0 <= value <= 1:
                raise UsageError(f"ppo.{name} is {value}; expected 0 to 1")
        for name, least in (("epochs", 1), ("minibatches", 1), ("entropy", 0)):
            if not getattr(self, name) >= least:
                raise UsageError(f"ppo.{name} is {getattr(self, name)}; expected at least {least}")

    def first_lr(self, *, clone: bool) -> float:
        """Return the first learning rate. clone: whether the actor is one."""
        return self.lr if self.lr is not None else 2e-4 if clone else 5e-4

    def discount(self, *, clone: bool) -> float:
        """Return gamma, by default longer for a clone, which lives to see what comes of its actions."""
        return self.gamma if self.gamma is not None else 0.97 if clone else 0.9


@dataclass(frozen=True)
class DiscriminatorConfig:
    """Options of a discriminator. Raises `UsageError` for a value out of range."""

    width: int = option(128, "units in each of the two hidden layers")
    lr: float = option(1e-3, "learning rate")
    steps: int = option(10, "gradient steps an iteration")
    batch_size: int = option(256, "transitions of the expert in a step, and as many of the learner")
    penalty: float = option(1.0, "weight of the gradient penalty; 0: none")

    def __post_init__(self) -> None:
        for name in ("width", "steps", "batch_size"):
            if getattr(self, name) < 1:
                raise UsageError(f"discriminator.{name} is {getattr(self, name)}; expected at least 1")
        if not 0 < self.lr < 1:
            raise UsageError(f"discriminator.lr is {self.lr}; expected more than 0, less than 1")
        if not 0 <= self.penalty < math.inf:
            raise UsageError(f"discriminator.penalty is {self.penalty}; expected at least 0")
