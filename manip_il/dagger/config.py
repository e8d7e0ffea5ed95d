"""What one DAgger run is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from manip_il.dagger.beta import BetaSchedule
from manip_il.errors import UsageError
from manip_il.seeding import MAX_ROUNDS
from manip_il.sim.env import EnvConfig


@dataclass(frozen=True)
class FitConfig:
    """How every round's policy is fitted (see `manip_il.learn.train.TrainConfig`)."""

    loss: str = "mse"
    steps: int = 3_000
    batch_size: int = 512
    width: int = 256
    depth: int = 3
    threads: int = 1


@dataclass(frozen=True)
class DaggerConfig:
    """Ross, Gordon & Bagnell 2011, algorithm 3.1, with the expert's own demonstrations as round 0.

    rounds: after round 0. beta: see `BetaSchedule`. refit: each round's policy from scratch, or warm from the
    last one's. validation_episodes: on which the best round is chosen; disjoint from the test's by their stream.
    hold: end a rollout this many steps after success. disturbed_share: of a round's rollouts that run under
    `manip_il.sim.disturb.STANDARD`; 0 is the algorithm in an undisturbed world.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    demonstrations: int = 50
    rounds: int = 5
    episodes_per_round: int = 50
    beta: str = "constant:0"
    refit: Literal["scratch", "warm"] = "scratch"
    fit: FitConfig = field(default_factory=FitConfig)
    validation_episodes: int = 200
    hold: int = 10
    disturbed_share: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        BetaSchedule.parse(self.beta)
        for name, least in (
            ("demonstrations", 1),
            ("rounds", 0),
            ("episodes_per_round", 1),
            ("validation_episodes", 1),
        ):
            if getattr(self, name) < least:
                raise UsageError(f"{name} is {getattr(self, name)}; expected at least {least}")
        if not 0 <= self.disturbed_share <= 1:
            raise UsageError(f"disturbed_share is {self.disturbed_share}; expected 0 to 1")
        if self.rounds >= MAX_ROUNDS:
            raise UsageError(f"rounds is {self.rounds}; expected fewer than {MAX_ROUNDS}")
