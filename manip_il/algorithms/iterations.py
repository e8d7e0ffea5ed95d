"""The iterations of a run of reinforcement learning: what is told of each, and those that were validated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from manip_il.errors import ManipError
from manip_il.evaluation.results import FILE_NAME, EvalResult

VALIDATION = "validation"
Stage = Literal["collect", "fit", "validate"]
STAGES: tuple[Stage, ...] = ("collect", "fit", "validate")


@dataclass(frozen=True)
class Iteration:
    """Outcome of an iteration; number 0 is what it began with. validation: of its policy, None where none was due.

    steps, episodes: simulated so far. seconds: what collecting, fitting and validating took, 0 of one that was found
    finished on disk.
    """

    number: int
    steps: int
    episodes: int
    metrics: dict[str, float]
    policy: Path
    validation: EvalResult | None
    seconds: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """Return the line of `metrics.jsonl`."""
        success = None if self.validation is None else self.validation.success
        return {
            "iteration": self.number,
            "steps": self.steps,
            "episodes": self.episodes,
            **self.metrics,
            "validation_success": None if success is None else success.rate,
            "validation_episodes": None if success is None else success.n,
            "seconds": self.seconds,
        }


def validations(folder: Path) -> dict[int, EvalResult]:
    """Return a run's validations by iteration, in order; raises `ManipError` for one that cannot be read."""
    return {int(path.parent.name): EvalResult.read(path) for path in sorted(folder.glob(f"{VALIDATION}/*/{FILE_NAME}"))}


def validated(folder: Path, number: int) -> Path:
    """Return the folder of a validated iteration: its policy and `eval.json`."""
    return folder / VALIDATION / f"{number:06d}"


def best_validation(found: dict[int, EvalResult]) -> int:
    """Return the iteration with the highest validation success, the later of equals."""
    if not found:
        raise ManipError("the run has no validation; expected one at its end")
    return max(found, key=lambda number: (found[number].success.rate, number))
