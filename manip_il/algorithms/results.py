"""Results of a run: timing, one result per round or iteration, the best one, and the report."""

import time
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from manip_il.data.atomic import read_lines
from manip_il.errors import ManipError
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.eval_report import run_report
from manip_il.evaluation.report import Report
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.evaluation.side import METRICS_FILE, Member, Side, history

STAGES = ("collect", "fit", "validate")
VALIDATION = "validation"


class Stopwatch:
    """Seconds spent in each stage."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}

    @contextmanager
    def timed(self, stage: str) -> Generator[None]:
        """Add the time spent inside the `with` block to a stage."""
        started = time.monotonic()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.monotonic() - started

    def take(self) -> dict[str, float]:
        """Return the seconds spent in each stage since the last call, rounded."""
        taken, self._seconds = dict.fromkeys(STAGES, 0.0) | self._seconds, {}
        return {stage: round(seconds, 3) for stage, seconds in taken.items()}


@dataclass(frozen=True)
class Result:
    """One finished round of imitation, or iteration of reinforcement learning.

    Iteration 0 is the initial policy.

    Attributes:
        unit: What was finished.
        number: Its number.
        steps: Control steps simulated so far.
        episodes: Episodes simulated so far.
        metrics: Metrics of the method by name, such as `labels`, the valid labels learnt from so
            far.
        policy: The checkpoint.
        validated: The validation; None if none was due.
        seconds: Time by stage [s]; 0 for stages that were already on disk.
    """

    unit: Literal["round", "iteration"]
    number: int
    steps: int
    episodes: int
    metrics: dict[str, float]
    policy: Path
    validated: EvalResult | None
    seconds: dict[str, float]

    @property
    def validation(self) -> EvalResult:
        """Validation result.

        Raises:
            ManipError: The policy was not validated.
        """
        if self.validated is None:
            raise ManipError(f"{self.unit} {self.number} was not validated")
        return self.validated

    @property
    def labels(self) -> int:
        """Number of valid labels that policies have learnt from so far."""
        return int(self.metrics["labels"])

    def to_json(self) -> dict[str, Any]:
        """Return one line of `metrics.jsonl`."""
        success = self.validated and self.validated.success
        return {
            self.unit: self.number,
            "steps": self.steps,
            "episodes": self.episodes,
            **self.metrics,
            "validation_success": success and success.rate,
            "validation_interval": success and list(success.interval),
            "validation_episodes": success and success.n,
            "seconds": self.seconds,
        }


def best_result(results: Iterable[Result]) -> Result:
    """Return the result with the highest validation success.

    On a tie the latest, which has seen the most data.
    """
    return max(results, key=lambda result: (result.validation.success.rate, result.number))


def validations(folder: Path) -> dict[int, EvalResult]:
    """Return the validations of a reinforcement learning run, in order, by iteration."""
    return {
        int(path.parent.name): EvalResult.read(path)
        for path in sorted(folder.glob(f"{VALIDATION}/*/{FILE_NAME}"))
    }


def best_validation(found: Mapping[int, EvalResult]) -> int:
    """Return the iteration with the highest validation success; on a tie the latest."""
    return max(found, key=lambda number: (found[number].success.rate, number))


def validation_report(
    folder: Path, title: str, first: str, found: Mapping[int, EvalResult]
) -> Report:
    """Return the report of a run.

    Args:
        folder: The run's folder.
        title: The page's title.
        first: Name of the policy with number 0.
        found: Validations by round or iteration, at least one.
    """
    records = read_lines(folder / METRICS_FILE)
    best, runs = best_validation(found), history(records, title)
    labels = {one["round"]: one["labels"] for one in records if "round" in one}
    names = {number: f"{runs[0].unit} {number}" for number in found} | {0: first}
    sides = {
        number: Side.of(names[number], result, labels=labels.get(number))
        for number, result in found.items()
    }
    facts = [
        "The best policy was chosen on these episodes, which overestimate it; measure it with"
        " manip-il eval."
    ]
    if 0 in found and best:
        facts.insert(0, Comparison(sides[0], sides[best]).verdict)
    return run_report(
        [sides[number] for number in labels or sorted({min(found), best, max(found)})],
        [Side(title, (Member(Path(title), history=runs),))],
        title=title,
        verdict=(
            f"Best {names[best]}: validation success {found[best].success} of"
            f" {found[best].success.n:,} episodes."
        ),
        facts=tuple(facts),
        fingerprint=found[best].fingerprint,
    )
