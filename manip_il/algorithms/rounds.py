"""The parts of a round: who drives its rollouts, what comes of them, the policy, and how good that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # algorithms are read for help and mistakes, too, before anything heavy is imported
    from manip_il.collect.drivers import Driver
    from manip_il.evaluation.results import EvalResult

Noise = tuple[tuple[float, ...], ...]  # covariance (n, n) of actions


def noisy_expert(noise: Noise) -> Driver:
    """Execute the expert's labels with Gaussian noise of a covariance (Laskey et al. 2017)."""
    from manip_il.collect.drivers import NoisyExpertDriver

    return NoisyExpertDriver(noise)


def mixture(policy: Fitted, beta: float) -> Driver:
    """Execute the expert's label with probability beta in each step, else the learner's action (Ross et al. 2011)."""
    from manip_il.collect.drivers import PolicyDriver

    return PolicyDriver(policy.members, beta, policy.trust)


@dataclass(frozen=True)
class Rollouts:
    """One round's episodes. dataset: None where the expert gave no label. beta: the expert's share of the steps.

    labels: sound ones. queries: states in which the expert was queried. episodes, successes: of the rollouts. steps:
    control steps simulated.
    """

    round: int
    dataset: Path | None
    beta: float
    labels: int
    queries: int
    episodes: int
    successes: int
    steps: int


@dataclass(frozen=True)
class Fitted:
    """A round's policy. members: the `pretrained_model` folders of an ensemble, of which the first drives.

    trust: whether models that they name may be loaded.
    """

    round: int
    members: tuple[Path, ...]
    trust: bool = False

    @property
    def path(self) -> Path:
        """Return the checkpoint of the policy that drives."""
        return self.members[0]


@dataclass(frozen=True)
class RoundResult:
    """One finished round. policy: its checkpoint. Times in [s].

    labels: sound labels learnt from so far. queries: states in which the expert was queried so far, which is more where
    it must answer to decide (`safety`, `dart`'s held-out episodes). episodes: rollouts so far. steps: control steps
    simulated so far. rollout_success: of this round's rollouts.
    """

    round: int
    beta: float
    labels: int
    queries: int
    episodes: int
    steps: int
    rollout_success: float
    policy: Path
    validation: EvalResult
    seconds: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """Return one line of `metrics.jsonl`."""
        success = self.validation.success
        first = ("round", "beta", "labels", "queries", "episodes", "steps", "rollout_success")
        return {name: getattr(self, name) for name in first} | {
            "validation_success": success.rate,
            "validation_interval": list(success.interval),
            "validation_episodes": success.n,
            "seconds": self.seconds,
        }


def best_round(results: Sequence[RoundResult]) -> RoundResult:
    """Return the highest validation success; of equals the later, which has seen more."""
    return max(results, key=lambda result: (result.validation.success.rate, result.round))
