"""The parts of a round of imitation: its rollouts, the policy that is fitted, and how good that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # read for help, too, before anything heavy is imported
    from manip_il.evaluation.results import EvalResult


@dataclass(frozen=True)
class Rollouts:
    """One round's episodes. dataset: None if the expert gave no label. beta: the expert's share of the steps.

    labels: sound ones. queries: states in which the expert was queried. episodes, successes: of the rollouts. steps:
    control steps simulated.
    """

    round: int
    dataset: Path | None = None
    beta: float = 1.0
    labels: int = 0
    queries: int = 0
    episodes: int = 0
    successes: int = 0
    steps: int = 0


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
