"""`report.html` of one evaluation, and of a run's policies beside each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from manip_il.evaluation.failures import (
    MAX_MARKS,
    evaluation_facts,
    evaluation_verdict,
    failure_maps,
    phase_table,
)
from manip_il.evaluation.figures import Bar, Curve, rates_figure
from manip_il.evaluation.report import Film, Report, Section, curve_section
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.tables import BASELINE, DAGGER, NO_CONDITION, PolicyRow, Table, evaluation_table, policy_table
from manip_il.sim.conditions import words

MAP_NOTE = (
    "Circles: starts, squares: goals, crosses: where failed episodes ended. "
    f"Of each outcome {MAX_MARKS} episodes are drawn at most."
)


def eval_report(
    result: EvalResult,
    command: str,
    config: Mapping[str, Any] | None = None,
    films: Mapping[bool, Sequence[Film]] | None = None,
    no_films: str = "",
    curve: Curve | None = None,
) -> Report:
    """Return the report of an evaluation.

    films: of failures (False) and successes (True). no_films: why there are none. curve: of the run of the policy.
    """
    sections = [_results(result), *([curve_section([curve])] if curve else []), *_failures(result)]
    return Report(
        title=f"Evaluation of {result.policy}: {result.robot} {result.task}",
        verdict=evaluation_verdict(result),
        facts=evaluation_facts(result),
        command=command,
        sections=(*sections, *film_sections(films or {}, no_films)),
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
    """Return the report of policies of a run, one a row. parts: title, verdict and the like, see `Report`."""
    sizes = sorted({row.success.n for row in rows})
    episodes = " to ".join(f"{size:,}" for size in dict.fromkeys((sizes[0], sizes[-1])))
    note = f"Each policy ran {episodes} episodes. Intervals are Wilson's score intervals."
    if disturbed := next((row.disturbed for row in rows if row.disturbed), None):
        note += f" Disturbed: {disturbed.settings.disturbance}."
    bars = [Bar(row.name, (row.success,), row.colour) for row in rows]
    results = Section("Results", figures=(rates_figure(bars),), tables=(policy_table(rows),), notes=(note,))
    curve = [curve_section(curves)] if curves else []
    looks = [Section("How it looks", lead=_no_films(no_films), films=tuple(films))] if films or no_films else []
    return Report(sections=(results, *curve, *looks), **parts)


def film_sections(films: Mapping[bool, Sequence[Film]], no_films: str) -> list[Section]:
    """Return the films of failures, which are what one can act on, before those of successes."""
    found = [(name, films[good]) for good, name in ((False, "Failures"), (True, "Successes")) if films.get(good)]
    if not found:
        return [Section("How it looks", lead=_no_films(no_films))] if no_films else []
    parts = [Section(name, films=tuple(some), under=True) for name, some in found]
    return [Section("How it looks"), *parts]


def _no_films(why: str) -> tuple[str, ...]:
    return (f"No films: {why}",) if why else ()


def _results(result: EvalResult) -> Section:
    settings, parts = result.settings, result.by_condition
    table = evaluation_table(result)
    if len(parts) > 1:
        (_, *total), *rows = table.rows
        named = (("all conditions", *total), *((row[0].strip(), *row[1:]) for row in rows))
        table = Table(("condition", *table.columns[1:]), named, (BASELINE, *[DAGGER] * len(rows)))
        bars = [Bar(name or NO_CONDITION, (part.success,)) for name, part in parts.items()]
        bars.insert(0, Bar("all conditions", (result.success,), BASELINE))
    else:
        table, bars = replace(table, colours=(DAGGER,)), [Bar(result.policy, (result.success,))]
    ends = "" if settings.hold is None else f"; an episode ends {settings.hold} steps after it"
    intervals = "Intervals are Wilson's score intervals."
    if result.until_width is not None:
        intervals = "Intervals are of a confidence sequence: they hold whenever one stops."
    note = (
        f"{result.success.n:,} episodes of at most {settings.horizon:,} control steps. Success: an error of at most "
        f"{100 * settings.tolerance:g} cm for {settings.success_steps} control steps in a row{ends}. {intervals}"
    )
    drawn = {
        one.name: ", ".join(f"{name} {words(range_)}" for name, range_ in one.ranges.items()) or "nothing"
        for one in settings.conditions
    }
    ranges = {"What the conditions draw": drawn} if any(one.ranges for one in settings.conditions) else {}
    return Section("Results", figures=(rates_figure(bars),), tables=(table,), notes=(note,), named=ranges)


def _failures(result: EvalResult) -> list[Section]:
    failed = result.success.n - result.success.successes
    lead = () if failed else (f"No failure in {result.success.n:,} episodes.",)
    figures, table = failure_maps(result), phase_table([("failed episodes", result.episodes)], result.task)
    if not figures and table is None and failed:
        return []
    notes = (MAP_NOTE,) if figures else ()
    return [Section("Where it fails", lead, figures=figures, tables=(table,) if table else (), notes=notes)]
