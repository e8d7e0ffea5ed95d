"""`report.html` of an evaluation, a run's policies or a comparison: success, failures, costs and
films.
"""

import textwrap
from collections import Counter
from collections.abc import Sequence
from typing import Any

from manip_il.errors import printable
from manip_il.evaluation.comparison import Study
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import (
    COLOURS,
    INK,
    INTERVAL,
    Figure,
    Film,
    Report,
    Section,
    Table,
    drawing,
    to_figure,
)
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.side import Side, costs_of
from manip_il.worlds.contract import UNNAMED

_MARKERS = ("o-", "s-", "D-", "^-")  # distinguishable without colour
_PANEL = (4.4, 3.0)  # size of a figure placed beside others [inches]


def eval_report(result: EvalResult, films: Sequence[Film] = ()) -> Report:
    """Return the report of an evaluation.

    Args:
        result: The evaluation.
        films: The films to show.
    """
    settings, success = result.settings, result.success
    end = "" if settings.hold is None else f", and end {settings.hold} steps after success"
    note = f"Episodes have at most {settings.horizon:,} control steps{end}."
    if result.until_width is not None:
        note += (
            " Intervals are from a confidence sequence, which is valid whenever the evaluation"
            " stops."
        )
    verdict = (
        f"{result.policy} succeeds in {success} of {success.n:,} unseen episodes of {result.robot}"
        f" {result.task}"
    )
    phase, count = next(iter(result.failures.items()), ("", 0))
    if phase not in ("", *UNNAMED):  # else nothing failed, or the expert names no phases
        verdict += (
            f"; {count:,} of its {success.n - success.successes:,} failures end in the phase"
            f" {phase}"
        )
    return run_report(
        condition_sides(result),
        films=films,
        note=note,
        failed=[Side.of("failed episodes", result)],
        title=f"Evaluation of {result.policy}: {result.robot} {result.task}",
        verdict=f"{verdict}.",
    )


def compare_report(study: Study, title: str) -> Report:
    """Return the report of a comparison of sides."""
    sides = study.sides
    first = sides[0].results[0]
    note = (
        f"Every policy ran {first.success.n:,} test episodes on the same seeds, which selected no"
        " policy."
    )
    if len(sides[0].members) > 1:
        note += " In brackets: each training seed."
    what = first.robot if study.baseline is None else f"{first.robot} {first.task}"
    return run_report(
        sides,
        [side for side in sides if side.histories],
        table=study.table(),
        note=note,
        failed=[] if study.baseline is None else sides,
        target=study.target,
        title=f"{title}: {what}",
        verdict=study.verdict,
        facts=tuple(study.facts),
    )


def run_report(
    sides: Sequence[Side],
    runs: Sequence[Side] = (),
    films: Sequence[Film] = (),
    *,
    table: Table | None = None,
    note: str = "",
    failed: Sequence[Side] = (),
    target: float | None = None,
    **parts: Any,
) -> Report:
    """Return the report of policies, one per side: success, failures, costs and films.

    Args:
        sides: Measured sides; the conditions of a disturbed one are named.
        runs: Sides whose rounds are drawn as curves.
        films: Films of episodes.
        table: Table of the results, by default that of `success_table`.
        note: A paragraph below the table.
        failed: Sides whose failed episodes are counted by the phase that they ended in.
        target: Validation success that is marked in the curves, in [0, 1].
        parts: Other fields of `Report`, such as the title.
    """
    tested = next((side.disturbed for side in sides if side.disturbed), sides[0].results[0])
    if tested.settings.disturbance != "none":
        note = f"{note} Conditions: {tested.settings.disturbance}.".lstrip()
    table = table or success_table(sides)
    sections = [Section("Results", tables=(table,), notes=(note,))]
    counted = [
        sum((Counter(result.failures) for result in side.results), Counter[str]())
        for side in failed
    ]
    phases = [phase for phase, _ in sum(counted, Counter[str]()).most_common() if phase]
    if phases:
        rows = tuple((phase, *(f"{counts[phase]:,}" for counts in counted)) for phase in phases)
        failures = Table(("phase that it ended in", *(side.name for side in failed)), rows)
        sections.append(Section("Where they fail", tables=(failures,)))
    if runs:
        words = (
            "Validation success by round of each run. Seconds are of collecting and fitting,"
            " without validating."
        )
        sections.append(
            Section("Success against cost", figures=curve_figures(runs, target), notes=(words,))
        )
    if films:
        sections.append(Section("How it looks", films=tuple(films)))
    parts.setdefault("fingerprint", tested.fingerprint)
    return Report(sections=tuple(sections), **parts)


def condition_sides(result: EvalResult) -> list[Side]:
    """Return an evaluation as the sides of a report: all episodes and, if there are several,
    each task's and each condition's.
    """
    conditions = result.by_condition if len(result.by_condition) > 1 else {}
    named = result.by_task | {name or "without a condition": of for name, of in conditions.items()}
    if not named:
        return [Side.of(result.policy, result)]
    parts = [Side.of(name, part) for name, part in named.items()]
    whole = "all conditions" if conditions else "all tasks"
    return [Side.of(whole, result), *parts]


def success_table(sides: Sequence[Side]) -> Table:
    """Return one row per policy or condition, given sides of one evaluation each.

    Columns: episodes, expert labels, success, success at the end, control steps to success, success
    when disturbed.
    """
    rows: list[tuple[str, ...]] = []
    for side in sides:
        [result] = side.results
        rows.append(
            (
                side.name,
                f"{result.success.n:,}",
                "" if side.labels is None else f"{side.labels:,}",
                str(result.success),
                str(result.success_at_end),
                "" if result.steps_to_success is None else f"{result.steps_to_success:.1f}",
                str(side.disturbed.success) if side.disturbed else "",
            )
        )
    head = (
        "",
        "episodes",
        "expert labels",
        f"success {INTERVAL}",
        "success at end",
        "steps to success",
    )
    return Table((*head, "success, disturbed"), tuple(rows))


def curve_figures(sides: Sequence[Side], target: float | None = None) -> tuple[Figure, ...]:
    """Draw the validation success of each run of the sides against every cost, one figure each.

    Args:
        sides: The sides.
        target: Success that is drawn as a horizontal line, in [0, 1].
    """
    figures: list[Figure] = []
    for cost in costs_of(run for side in sides for run in side.histories):
        with drawing(1, size=_PANEL) as (drawn, axes):
            axis = axes[0, 0]
            for place, side in enumerate(sides):
                label = printable(textwrap.shorten(side.name, 40)).replace("$", r"\$")
                for run in side.histories:
                    rates = [100 * one.validation.rate for one in run]
                    axis.plot(
                        [one.amount(cost) for one in run],
                        rates,
                        _MARKERS[place % 4],
                        c=COLOURS[place % len(COLOURS)],
                        label=label,
                    )
                    label = ""  # one entry per side in the legend
            if target is not None:
                axis.axhline(
                    100 * target,
                    color=INK,
                    ls="--",
                    lw=1,
                    label=f"target, {format_percent(target)}",
                )
            axis.set(xlabel=cost, ylim=(-2, 102), ylabel="validation success [%]")
            drawn.legend(loc="outside upper left", ncols=2)
            figures.append(
                to_figure(
                    drawn, f"Validation success over {cost}: {', '.join(one.name for one in sides)}"
                )
            )
    return tuple(figures)
