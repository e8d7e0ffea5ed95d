"""`report.html` of one evaluation: success, where it fails, films, and what made it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

from manip_il.evaluation.failures import (
    Factor,
    PhaseRow,
    evaluation_facts,
    evaluation_verdict,
    factor_table,
    find_factors,
    phase_rows,
)
from manip_il.evaluation.maps import FailureMap, Outcome, failure_map
from manip_il.evaluation.report import Bar, Report
from manip_il.evaluation.report_data import Film, LearningCurve, Paths
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.tables import NO_CONDITION, Table, evaluation_table
from manip_il.sim.conditions import words

AXES_NOTE = "x leads away from the robot, y to its left"


def eval_report(
    result: EvalResult,
    command: str,
    config: Mapping[str, Any] | None = None,
    films: tuple[Film, ...] = (),
    paths: tuple[Paths, ...] = (),
    pictures_note: str = "",
    curve: LearningCurve | None = None,
) -> EvalReport:
    """Return the report of an evaluation. curve: of the run that the policy is of."""
    factors = find_factors(result)
    return EvalReport(
        title=f"Evaluation of {result.policy}: {result.robot} {result.task}",
        verdict=evaluation_verdict(result),
        facts=evaluation_facts(result, factors),
        command=command,
        config=config or {},
        fingerprint=result.fingerprint,
        films=films,
        paths=paths,
        pictures_note=pictures_note,
        result=result,
        factors=factors,
        curve=curve,
    )


@dataclass(frozen=True, kw_only=True)
class EvalReport(Report):
    """The report of one evaluation, made by `eval_report`."""

    template: ClassVar[str] = "eval.html.j2"
    result: EvalResult
    factors: tuple[Factor, ...]

    @property
    def table(self) -> Table:
        """All episodes, then each condition, in numbers."""
        table = evaluation_table(self.result)
        if len(table.rows) == 1:
            return replace(table, kinds=("dagger",))
        (_, *total), *rows = table.rows
        rows = (("all conditions", *total), *((row[0].strip(), *row[1:]) for row in rows))
        return Table(("condition", *table.columns[1:]), rows, ("baseline", *["dagger"] * (len(rows) - 1)))

    @cached_property
    def bars(self) -> list[Bar]:
        """The same success."""
        parts = self.result.by_condition
        if len(parts) == 1:
            return [Bar.of(self.result.policy, "dagger", self.result.success)]
        bars = [Bar.of(name or NO_CONDITION, "dagger", part.success) for name, part in parts.items()]
        return [Bar.of("all conditions", "baseline", self.result.success), *bars]

    @property
    def note(self) -> str:
        """Number of episodes, meaning of success, method of the intervals."""
        settings, parts = self.result.settings, self.result.by_condition
        sizes = sorted({part.success.n for part in parts.values()})
        each = f"{sizes[0]:,}" if len(sizes) == 1 else f"{sizes[0]:,} to {sizes[-1]:,}"
        apart = f", {each} in each condition" if len(parts) > 1 else ""
        ends = "" if settings.hold is None else f"; an episode ends {settings.hold} steps after it"
        intervals = "Intervals are Wilson's score intervals."
        if self.result.until_width is not None:
            intervals = "Intervals are of a confidence sequence: they hold whenever one stops."
        return (
            f"{self.result.success.n:,} episodes of at most {settings.horizon:,} control steps{apart}. "
            f"Success means an error of at most {100 * settings.tolerance:g} cm for {settings.success_steps} "
            f"control steps in a row{ends}. {intervals}"
        )

    @property
    def ranges(self) -> dict[str, str]:
        """Condition -> the numbers it draws and their ranges; empty where none draws any."""
        drawn = {
            one.name: ", ".join(f"{name} {words(range_)}" for name, range_ in one.ranges.items())
            for one in self.result.settings.conditions
        }
        return {name: words or "nothing" for name, words in drawn.items()} if any(drawn.values()) else {}

    @property
    def failed(self) -> int:
        """Number of failed episodes."""
        return self.result.success.n - self.result.success.successes

    @cached_property
    def map(self) -> FailureMap | None:
        """Starts and goals; None where no episode has them."""
        return failure_map(self.result)

    @property
    def map_names(self) -> dict[Outcome, str]:
        """Outcomes in words."""
        assert self.map is not None
        solved = f"solved: {self.map.moving}'s start (circle) and goal (square)"
        return {"solved": solved, "failed": "failed: from start to goal"}

    @property
    def map_note(self) -> str:
        """Number of episodes in the map, and its axes."""
        assert self.map is not None
        solved = len(self.map.marks) - self.map.failed
        return (
            f"{self.failed:,} failed and {solved:,} solved episodes by where the {self.map.moving} started and was to "
            f"go. {AXES_NOTE}; z is the height above the table. {self.map.thinning_note}"
        )

    @cached_property
    def phases(self) -> tuple[PhaseRow, ...]:
        """Failed episodes by phase; empty where none failed or no phase is known."""
        return phase_rows([self.result.episodes], self.result.task) if any(self.result.failures) else ()

    @property
    def phases_note(self) -> str:
        """Meaning of the phases."""
        count = "The one failed episode" if self.failed == 1 else f"The {self.failed:,} failed episodes"
        return f"{count} by the phase of the task that the expert assigned to the last state, in task order."

    @cached_property
    def significant(self) -> Table:
        """Factors that failures are associated with."""
        return factor_table([factor for factor in self.factors if factor.significant])

    @cached_property
    def insignificant(self) -> Table:
        """The other factors."""
        return factor_table([factor for factor in self.factors if not factor.significant])

    @property
    def no_factor(self) -> str:
        """Sentence in place of a table without rows."""
        if len(self.factors) == 1:
            return f"Failures are not associated with {self.factors[0].name} beyond chance."
        return f"Failures are associated with none of the {len(self.factors)} numbers that varied, beyond chance."

    @property
    def factors_note(self) -> str:
        """Meaning of the table's numbers."""
        confidence = f"{100 * self.result.confidence:g} %"
        count = f"{len(self.factors)} that varied" if len(self.factors) > 1 else "one that varied"
        return (
            f"Success with its {confidence} interval (Wilson) in thirds of the episodes by start, goal and what was "
            "drawn; under it, the values of that third; equal values stay together. p: Fisher's exact test of all "
            f"three, corrected (Holm) for the {count}. An association with a number does not show that it causes the "
            "failures."
        )
