"""What one DAgger run is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from manip_il.dagger.beta import BetaSchedule
from manip_il.dagger.sampling import Sampling
from manip_il.engine.ask import Ask
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.seeding import MAX_ROUNDS
from manip_il.sim.env import EnvConfig
from manip_il.sim.look import CameraConfig

Method = Literal["dagger", "cloning", "dart"]
LabelMode = Literal["per_state", "takeover", "branch"]
_LEAST = {
    "demonstrations": 1,
    "rounds": 0,
    "episodes_per_round": 1,
    "validation_episodes": 1,
    "ensemble": 1,
    "label_budget": 1,
    "branch_steps": 1,
    "refit_steps": 1,
}


@dataclass(frozen=True)
class DaggerConfig:
    """Ross, Gordon & Bagnell 2011, algorithm 3.1, with the expert's own demonstrations as round 0.

    method: who drives after round 0: the learner (`dagger`), the expert (`cloning`, with more demonstrations every
    round), or the expert with noise like the learner's errors (`dart`, Laskey et al. 2017).

    rounds: after round 0, fewer where label_budget, the sound labels of all rounds together, is reached before. beta:
    see `BetaSchedule`. label, branch_steps: what comes of a state in which the expert is asked, see `RolloutJob`;
    branch_steps None: as many as the policy plans. ask: where it is asked, see `Ask`; None: everywhere, for `takeover`
    once an episode, for `branch` so often that there are as many labels as steps. ensemble: policies fitted every
    round, of which the first drives.

    refit: each round's policy from scratch, or warm from the last one's in refit_steps. validation_episodes: on which
    the best round is chosen; disjoint from the test's by their stream. hold: end a rollout, of validation too, this
    many steps after success. disturbed_share: of a round's learner rollouts that run under
    `manip_il.sim.disturb.STANDARD`; 0 is the algorithm in an undisturbed world. cameras: what is pictured.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    method: Method = "dagger"
    demonstrations: int = 50
    rounds: int = 5
    episodes_per_round: int = 50
    label_budget: int | None = None
    beta: str = "constant:0"
    label: LabelMode = "per_state"
    ask: str | None = None
    branch_steps: int | None = None
    ensemble: int = 1
    sampling: Sampling = field(default_factory=Sampling)
    refit: Literal["scratch", "warm"] = "scratch"
    refit_steps: int | None = None
    fit: FitConfig = field(default_factory=FitConfig)
    validation_episodes: int = 200
    hold: int = 10
    disturbed_share: float = 0.5
    cameras: CameraConfig | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise UsageError(f"{name} is {value}; expected at least {least}")
        if not 0 <= self.disturbed_share <= 1:
            raise UsageError(f"disturbed_share is {self.disturbed_share}; expected 0 to 1")
        if self.rounds >= MAX_ROUNDS:
            raise UsageError(f"rounds is {self.rounds}; expected fewer than {MAX_ROUNDS}")
        beta = BetaSchedule.parse(self.beta)
        asked = Ask.parse(self.ask) if self.ask is not None else Ask()
        if self.method != "dagger" and (self.label, self.ask, beta) != ("per_state", None, BetaSchedule("constant", 0)):
            raise UsageError(f"method {self.method!r} has the expert drive throughout; leave out label, ask and beta")
        if self.label == "takeover" and beta != BetaSchedule("constant", 0):
            raise UsageError(f"label is 'takeover', so the learner rolls in alone; beta is {self.beta!r}, leave it out")
        if self.label == "takeover" and self.ask == "every":
            raise UsageError("label is 'takeover' and ask 'every': the expert would drive from the first step on")
        if asked.kind == "ensemble" and self.ensemble < 2:
            raise UsageError(f"ask is {self.ask!r}, but there is one policy; give ensemble=2 or more")
        if asked.kind != "ensemble" and self.ensemble > 1:
            raise UsageError(f"ensemble is {self.ensemble}, but nothing asks it; give ask=ensemble:BOUND too")
        if self.refit_steps is not None and self.refit == "scratch":
            raise UsageError("refit_steps is for refit=warm; a policy from scratch takes all steps")


def check_sight(config: DaggerConfig) -> None:
    """Raise `UsageError` unless what the policy sees is recorded, and nothing is pictured for a blind one."""
    sees = config.fit.sees
    if sees and config.fit.is_mlp:
        raise UsageError(
            f"--policy.type=mlp does not take images, so not --observation={config.fit.observation}; use cnn"
        )
    if sees and config.cameras is None:
        raise UsageError("the policy takes images, but none are rendered; give --cameras=front,wrist")
    if config.cameras is not None and not sees:
        raise UsageError("images are rendered, but the policy takes none; leave out --cameras or --observation=images")
    if sees and config.method == "dart":
        raise UsageError(
            "method 'dart' measures the learner's errors from state vectors; it is not for a policy on images"
        )
