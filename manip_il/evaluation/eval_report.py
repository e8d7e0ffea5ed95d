"""`report.html` of an evaluation, a run's policies or a comparison: success, failures, costs and films."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

from manip_il.evaluation.comparison import Study
from manip_il.evaluation.figures import (
    ARMS,
    Bar,
    Curve,
    Figure,
    curve_figures,
    curve_note,
    rates_figure,
    start_map,
)
from manip_il.evaluation.report import Film, Report, Section
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.tables import BASELINE, PolicyRow, Table, evaluation_table, policy_table
from manip_il.sim.task import phases
from manip_il.tasks.stock import table as stock
from manip_il.tasks.table import TASKS


def eval_report(
    result: EvalResult,
    command: str,
    config: Mapping[str, Any] | None = None,
    films: Sequence[Film] = (),
    no_films: str = "",
) -> Report:
    """Return the report of an evaluation. no_films: why there are no films, or empty."""
    fails = failures_sections(
        [("failed episodes", result.episodes)], result.task, "Where it fails", start_map(result.episodes)
    )
    if result.success.successes == result.success.n:
        fails = [Section("Where it fails", (f"No failure in {result.success.n:,} episodes.",))]
    return Report(
        title=f"Evaluation of {result.policy}: {result.robot} {result.task}",
        verdict=evaluation_verdict(result),
        command=command,
        sections=(_conditions(result), *fails, *_looks(films, no_films)),
        config=config or {},
        fingerprint=result.fingerprint,
    )


def run_report(
    rows: Sequence[PolicyRow],
    films: Sequence[Film] = (),
    no_films: str = "",
    curves: Sequence[Curve] = (),
    **parts: Any,
) -> Report:
    """Return the report of a run's policies, one per row. parts: other fields of `Report`, such as the title."""
    note = f"Each policy ran {rows[0].result.success.n:,} episodes. Intervals are Wilson's score intervals."
    note += next((disturbed_note(row.disturbed) for row in rows if row.disturbed), "")
    bars = [Bar(row.name, (row.result.success,), row.colour) for row in rows]
    results = Section("Results", figures=(rates_figure(bars),), tables=(policy_table(rows),), notes=(note,))
    return Report(sections=(results, *curve_sections(curves), *_looks(films, no_films)), **parts)


def compare_report(study: Study, title: str, command: str, config: Mapping[str, Any] | None = None) -> Report:
    """Return the report of a comparison of arms."""
    others = [arm.name for arm in study.arms if arm.name != study.baseline]
    palette = {name: ARMS[place % len(ARMS)] for place, name in enumerate(others)}
    colours = {arm.name: palette.get(arm.name, BASELINE) for arm in study.arms}
    first = study.arms[0].members[0].test
    of_arms = tuple(colours.values())
    results, *costs = (replace(table, colours=of_arms) for table in study.tables)
    bars = [Bar(arm.name, tuple(one.test.success for one in arm.members), colours[arm.name]) for arm in study.arms]
    same = "the same " if study.baseline is not None else ""
    note = f"Every policy ran {same}{first.success.n:,} test episodes, which were not used to select a policy."
    note += disturbed_note(first)
    if len(bars[0].successes) > 1:
        note += " In brackets and as dots: each training seed; the bar is their mean."
    sections = [Section("Results", figures=(rates_figure(bars),), tables=(results,), notes=(note,))]
    if study.baseline is not None:
        failed = [(arm.name, [*chain(*(one.test.episodes for one in arm.members))]) for arm in study.arms]
        sections += failures_sections(failed, first.task, "Where they fail")
    curves = [
        Curve(arm.name, tuple(member.history for member in arm.members), colours[arm.name])
        for arm in study.arms
        if arm.has_histories
    ]
    sections += curve_sections(curves, study.target if costs else None, tuple(costs))
    return Report(
        title=title,
        verdict=study.verdict,
        facts=tuple(study.facts),
        command=command,
        sections=tuple(sections),
        config=config or {},
        fingerprint=first.fingerprint,
    )


def failures_sections(
    policies: Sequence[tuple[str, Sequence[EpisodeResult]]], task: str, heading: str, figures: tuple[Figure, ...] = ()
) -> list[Section]:
    """Return a section with the figures and `phase_table`, if there are any. policies: name and episodes of each."""
    table = phase_table(policies, task)
    if not figures and table is None:
        return []
    return [Section(heading, figures=figures, tables=(table,) if table else ())]


def curve_sections(
    curves: Sequence[Curve], target: float | None = None, tables: tuple[Table, ...] = ()
) -> list[Section]:
    """Return a section on success against every cost; empty if there are no curves."""
    if not curves:
        return []
    note = curve_note(curves)
    return [Section("Success against cost", figures=curve_figures(curves, target), tables=tables, notes=(note,))]


def disturbed_note(result: EvalResult) -> str:
    """Return a sentence on the conditions, with a leading space; empty if there are none."""
    disturbance = result.settings.disturbance
    return "" if disturbance == "none" else f" Conditions: {disturbance}."


def phase_table(policies: Sequence[tuple[str, Sequence[EpisodeResult]]], task: str) -> Table | None:
    """Return failed episodes by the phase that they ended in, in the task's order, one column per policy.

    policies: names and episodes. Returns None if none failed or no phase is known.
    """
    counted = [Counter(e.phase_at_end for e in own if e.phase_at_end and not e.success) for _, own in policies]
    found = {name for counts in counted for name in counts}
    if not found:
        return None
    known = phases(TASKS[task]) if task in TASKS else ()
    names = [*known, *sorted(found.difference(known))]
    rows = ((_spaced(name), *(f"{counts[name]:,}" for counts in counted)) for name in names)
    return Table(("phase that it ended in", *(name for name, _ in policies)), tuple(rows))


def evaluation_verdict(result: EvalResult) -> str:
    """Return the report's first sentence: success with its interval, and the phase in which most failures end."""
    success = result.success
    verdict = f"{result.policy} succeeds in {success} of {success.n:,} unseen episodes of {result.robot} {result.task}"
    phase, count = next(iter(result.failures.items()), ("", 0))
    if not phase:  # nothing failed, or the file is from before phases were kept
        return f"{verdict}."
    return f"{verdict}; {count:,} of its {success.n - success.successes:,} failures end in the phase {_spaced(phase)}."


def _conditions(result: EvalResult) -> Section:
    """Return a section: success in all episodes and per condition, and what success and the conditions mean."""
    settings, table = result.settings, evaluation_table(result)
    successes = [result.success, *(part.success for part in result.by_condition.values())]
    bars = [
        Bar(row[0], (success,), colour)
        # with a single condition, the table has one row
        for row, success, colour in zip(table.rows, successes, table.colours, strict=False)
    ]
    hold = settings.hold
    ends = {None: "", 0: ", which ends the episode"}.get(hold, f"; an episode ends {hold} steps after it")
    intervals = "Intervals are Wilson's score intervals."
    if result.until_width is not None:
        intervals = "Intervals are from a confidence sequence, which is valid whenever the evaluation stops."
    solved = f"an error of at most {100 * settings.tolerance:g} cm for {settings.success_steps} control steps in a row"
    if result.robot in stock.ROBOTS:
        solved = "as the environment itself reports it"
    note = (
        f"{result.success.n:,} episodes of at most {settings.horizon:,} control steps. Success: {solved}{ends}. "
        f"{intervals}{disturbed_note(result)}"
    )
    return Section("Results", figures=(rates_figure(bars),), tables=(table,), notes=(note,))


def _looks(films: Sequence[Film], no_films: str) -> list[Section]:
    """Return a section with the films, or with the reason if there are none."""
    if not films and not no_films:
        return []
    return [Section("How it looks", (f"No films: {no_films}",) if no_films else (), films=tuple(films))]


def _spaced(phase: str) -> str:
    return phase.replace("_", " ")
