"""`report.html` of an evaluation, a run's policies or a comparison: success, failures, costs and films."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from manip_il.evaluation.comparison import Study
from manip_il.evaluation.figures import COLOURS, curve_figures, rates_figure
from manip_il.evaluation.report import Film, Report, Section
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.side import Side
from manip_il.evaluation.tables import BASELINE, INTERVAL, Table
from manip_il.worlds.table import world_of


def eval_report(result: EvalResult, films: Sequence[Film] = (), no_films: str = "") -> Report:
    """Return the report of an evaluation. no_films: why there are no films, or empty."""
    settings, sides = result.settings, condition_sides(result)
    solved = world_of(result.robot).success(settings.tolerance, settings.success_steps)
    end = "" if settings.hold is None else f"; an episode ends {settings.hold} steps after it"
    note = f"Episodes have at most {settings.horizon:,} control steps. Success: {solved}{end}."
    if result.until_width is not None:
        note += " Intervals are from a confidence sequence, which is valid whenever the evaluation stops."
    return Report(
        title=f"Evaluation of {result.policy}: {result.robot} {result.task}",
        verdict=evaluation_verdict(result),
        sections=(
            _results(sides, success_table(sides), note, result),
            *_failures([Side.of("failed episodes", result)]),
            *_films(films, no_films),
        ),
        fingerprint=result.fingerprint,
    )


def run_report(
    sides: Sequence[Side], runs: Sequence[Side], films: Sequence[Film] = (), no_films: str = "", **parts: Any
) -> Report:
    """Return the report of a run's policies, one per side.

    runs: whose rounds are drawn as curves. parts: other fields of `Report`, such as the title.
    """
    tested = next((side.disturbed for side in sides if side.disturbed), sides[0].results[0])
    results = _results(sides, success_table(sides), "", tested)
    return Report(sections=(results, *_curves(runs), *_films(films, no_films)), **parts)


def compare_report(study: Study, title: str) -> Report:
    """Return the report of a comparison of sides."""
    others = [side.name for side in study.sides if side.name != study.baseline]
    colours = dict(zip(others, itertools.cycle(COLOURS), strict=False))
    sides = [replace(side, colour=colours.get(side.name, BASELINE)) for side in study.sides]
    table = replace(study.table(), colours=tuple(side.colour for side in sides))
    first = sides[0].results[0]
    note = f"Every policy ran {first.success.n:,} test episodes on the same seeds, which selected no policy."
    if len(sides[0].members) > 1:
        note += " In brackets and in the figure: each training seed."
    failures = _failures(sides) if study.baseline is not None else []
    curves = _curves([side for side in sides if side.histories], study.target)
    what = first.robot if study.baseline is None else f"{first.robot} {first.task}"
    return Report(
        title=f"{title}: {what}",
        verdict=study.verdict,
        facts=tuple(study.facts),
        sections=(_results(sides, table, note, first), *failures, *curves),
        fingerprint=first.fingerprint,
    )


def condition_sides(result: EvalResult) -> list[Side]:
    """Return an evaluation as the sides of a report: all episodes and, if there are several, each condition's."""
    conditions = result.by_condition
    if len(conditions) < 2:
        return [Side.of(result.policy, result)]
    parts = [Side.of(name or "without a condition", part) for name, part in conditions.items()]
    return [Side.of("all conditions", result, colour=BASELINE), *parts]


def success_table(sides: Sequence[Side]) -> Table:
    """Return one row per policy or condition, given sides of one evaluation each.

    Columns: episodes, expert labels, success, success at the end, control steps to success, success when disturbed.
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
    head = ("", "episodes", "expert labels", f"success {INTERVAL}", "success at end", "steps to success")
    return Table((*head, "success, disturbed"), tuple(rows), tuple(side.colour for side in sides))


def evaluation_verdict(result: EvalResult) -> str:
    """Return the report's first sentence: success with its interval, and the phase in which most failures end."""
    success = result.success
    verdict = f"{result.policy} succeeds in {success} of {success.n:,} unseen episodes of {result.robot} {result.task}"
    phase, count = next(iter(result.failures.items()), ("", 0))
    if not phase:  # nothing failed, or the task has no phases
        return f"{verdict}."
    return f"{verdict}; {count:,} of its {success.n - success.successes:,} failures end in the phase {phase}."


def _results(sides: Sequence[Side], table: Table, note: str, tested: EvalResult) -> Section:
    """Return a section of success rates. tested: an evaluation whose conditions are added to the note."""
    disturbance = tested.settings.disturbance
    if disturbance != "none":
        note = f"{note} Conditions: {disturbance}.".lstrip()
    return Section("Results", figures=(rates_figure(sides),), tables=(table,), notes=(note,))


def _failures(sides: Sequence[Side]) -> list[Section]:
    """Return a section with the failed episodes of each side by the phase that they ended in; [] if none failed."""
    counted = [sum((Counter(result.failures) for result in side.results), Counter[str]()) for side in sides]
    total = sum(counted, Counter[str]()).most_common()
    rows = [(phase, *(f"{counts[phase]:,}" for counts in counted)) for phase, _ in total if phase]
    columns = ("phase that it ended in", *(side.name for side in sides))
    return [Section("Where they fail", tables=(Table(columns, tuple(rows)),))] if rows else []


def _curves(sides: Sequence[Side], target: float | None = None) -> list[Section]:
    """Return a section on success against every cost; [] if there are no runs."""
    if not sides:
        return []
    note = "Validation success by round of each run. Seconds are of collecting and fitting, without validating."
    return [Section("Success against cost", figures=curve_figures(sides, target), notes=(note,))]


def _films(films: Sequence[Film], no_films: str) -> list[Section]:
    """Return a section with the films, or with the reason if there are none."""
    if not films and not no_films:
        return []
    return [Section("How it looks", (f"No films: {no_films}",) if no_films else (), films=tuple(films))]
