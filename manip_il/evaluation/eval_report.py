"""`report.html` of one evaluation: how good, where it fails, how that looks, and what made it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from manip_il.errors import ManipError
from manip_il.evaluation import curve_sections, sections
from manip_il.evaluation.condition_chart import condition_rows, condition_words, success_bars
from manip_il.evaluation.drawn_table import drawn_table
from manip_il.evaluation.episode_facts import by_condition, has_object
from manip_il.evaluation.eval_words import eval_facts, eval_verdict
from manip_il.evaluation.factors import Factor, find_factors
from manip_il.evaluation.failure_map import failure_map, map_legend, map_marks, thinning_note
from manip_il.evaluation.phase_chart import phase_chart, phase_rows
from manip_il.evaluation.report import render_page
from manip_il.evaluation.report_data import Film, Kind, LearningCurve, Paths, Strip
from manip_il.evaluation.results import EvalResult


@dataclass(frozen=True)
class EvalReport:
    """One evaluation's whole story. Empty parts are left out of the page.

    command: what made it. films, strips, paths: of single episodes, with their outcome where it is known.
    pictures_note: one line about them, such as why there are none. curve: of the run that the policy is of. timings:
    what -> [s]. config: nested. kind: decides the colour. episodes: what the episodes are called in the first sentence.
    more_facts: further sentences under it.
    """

    result: EvalResult
    command: str
    config: Mapping[str, Any] = field(default_factory=dict[str, Any])
    films: tuple[Film, ...] = ()
    strips: tuple[Strip, ...] = ()
    paths: tuple[Paths, ...] = ()
    pictures_note: str = ""
    curve: LearningCurve | None = None
    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    kind: Kind = "dagger"
    episodes: str = "unseen episodes"
    more_facts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for what in ("command", "episodes"):
            if not getattr(self, what).strip():
                raise ManipError(f"report on {self.result.policy!r}: {what} is empty")

    @property
    def title(self) -> str:
        """What it is about."""
        return f"Evaluation of {self.result.policy}: {self.result.robot} {self.result.task}"

    @property
    def verdict(self) -> str:
        """The first sentence."""
        return eval_verdict(self.result, self.episodes)

    @cached_property
    def factors(self) -> tuple[Factor, ...]:
        """What failures may go with."""
        return find_factors(self.result)

    @property
    def facts(self) -> Sequence[str]:
        """Further sentences under the first."""
        return [*eval_facts(self.result, self.factors), *self.more_facts]

    @property
    def fingerprint(self) -> Mapping[str, Any]:
        """Of the evaluation."""
        return self.result.fingerprint


def eval_page(report: EvalReport) -> str:
    """Return the page as one string of HTML."""
    curve = report.curve
    return render_page(
        report.title,
        [
            sections.header(report),
            _results(report),
            curve_sections.curve(curve) if curve and curve.points else "",
            _where(report),
            drawn_table(report.factors),
            sections.pictures(report),
            sections.making(report),
        ],
    )


def _results(report: EvalReport) -> str:
    result = report.result
    rows = condition_rows(result, report.kind)
    conditions = condition_words(result)
    return sections.section(
        "Results",
        sections.policy_table(rows, "Condition" if len(rows) > 1 else "Policy"),
        success_bars(rows),
        f'<p class="note">{sections.prose(_how_measured(result))}</p>',
        sections.details("What the conditions draw", sections.pairs(conditions)) if conditions else "",
    )


def _how_measured(result: EvalResult) -> str:
    settings = result.settings
    sizes = sorted({len(episodes) for episodes in by_condition(result).values()})
    each = f"{sizes[0]:,}" if len(sizes) == 1 else f"{sizes[0]:,} to {sizes[-1]:,}"
    apart = f", {each} in each condition" if len(by_condition(result)) > 1 else ""
    ends = "" if settings.hold is None else f"; an episode ends {settings.hold} steps after it"
    intervals = "Intervals are Wilson's score intervals."
    if result.until_width is not None:
        intervals = "Intervals are of a confidence sequence: they hold whenever one stops."
    return (
        f"{result.success.n:,} episodes of at most {settings.horizon:,} control steps{apart}. "
        "Success means being within "
        f"{100 * settings.tolerance:g} cm of the goal for {settings.success_steps} control steps in a row{ends}. "
        + intervals
    )


def _where(report: EvalReport) -> str:
    result = report.result
    failed = result.success.n - result.success.successes
    if not failed:
        nothing = f"No failure in {result.success.n:,} episodes."
        return sections.section("Where it fails", f'<p class="lead">{nothing}</p>', _map(result, failed))
    parts = [_map(result, failed)]
    if any(result.failures):
        rows = phase_rows([result.episodes], result.task)
        parts += ["<h3>The phase that they ended in</h3>", phase_chart(rows, ["cloning"], [result.policy])]
        count = "The one failed episode" if failed == 1 else f"The {failed:,} failed episodes"
        words = f"{count} by the phase of the task that the expert assigned to the last state, in task order."
        parts.append(f'<p class="note">{sections.prose(words)}</p>')
    return sections.section("Where it fails", *parts) if any(parts) else ""


def _map(result: EvalResult, failed: int) -> str:
    marks = map_marks(result)
    if not marks:
        return ""
    thing = "object" if has_object(result) else "hand"
    solved = len(marks) - sum(mark.outcome == "failed" for mark in marks)
    note = [f"{failed:,} failed and {solved:,} solved episodes by where the {thing} started and was to go."]
    note += ["x leads away from the robot, y to its left; z is the height above the table.", thinning_note(marks)]
    words = {"solved": f"solved: {thing}'s start (circle) and goal (square)", "failed": "failed: from start to goal"}
    return (
        failure_map(marks, result.policy)
        + map_legend(marks, words, thing)  # pyright: ignore[reportArgumentType]
        + f'<p class="note">{sections.prose(" ".join(filter(None, note)))}</p>'
    )
