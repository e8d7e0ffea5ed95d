"""`report.html` of an evaluation and of a run's policies: how good, in every condition, where it fails, films."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from manip_il.evaluation.figures import (
    MAP_NOTE,
    Bar,
    Curve,
    Figure,
    curve_figures,
    curve_note,
    failure_map,
    rates_figure,
)
from manip_il.evaluation.report import Film, Report, Section
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.rounds import format_seconds
from manip_il.evaluation.tables import BASELINE, DAGGER, NO_CONDITION, PolicyRow, Table, evaluation_table, policy_table
from manip_il.sim.conditions import words
from manip_il.sim.task import NO_PHASE
from manip_il.tasks.table import TASKS

NOT_RECORDED = "not recorded"
_NO_PHASE = "not even the expert can continue: an object is off the table, or something is out of reach"


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
    failed = result.success.n - result.success.successes
    fails = failures_sections(
        [("failed episodes", result.episodes)], result.task, "Where it fails", failure_map(result.episodes)
    )
    if not failed:
        fails = [Section("Where it fails", (f"No failure in {result.success.n:,} episodes.",))]
    filmed = [(name, (films or {}).get(good)) for good, name in ((False, "Failures"), (True, "Successes"))]
    looks = [Section(name, films=tuple(some), under=True) for name, some in filmed if some]
    if looks or no_films:
        looks.insert(0, Section("How it looks", _no_films(no_films)))
    return Report(
        title=f"Evaluation of {result.policy}: {result.robot} {result.task}",
        verdict=evaluation_verdict(result),
        facts=evaluation_facts(result),
        command=command,
        sections=(_conditions(result), *curve_sections([curve] if curve else []), *fails, *looks),
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
    note += next((disturbed_note(row.disturbed) for row in rows if row.disturbed), "")
    bars = [Bar(row.name, (row.success,), row.colour) for row in rows]
    results = Section("Results", figures=(rates_figure(bars),), tables=(policy_table(rows),), notes=(note,))
    looks = [Section("How it looks", _no_films(no_films), films=tuple(films))] if films or no_films else []
    return Report(sections=(results, *curve_sections(curves), *looks), **parts)


def failures_sections(
    policies: Sequence[tuple[str, Sequence[EpisodeResult]]], task: str, heading: str, figures: tuple[Figure, ...] = ()
) -> list[Section]:
    """Return the phases that failed episodes of policies (name, episodes) ended in, after the figures; else nothing."""
    table = phase_table(policies, task)
    if not figures and table is None:
        return []
    return [Section(heading, figures=figures, tables=(table,) if table else (), notes=(MAP_NOTE,) if figures else ())]


def curve_sections(
    curves: Sequence[Curve], target: float | None = None, tables: tuple[Table, ...] = ()
) -> list[Section]:
    """Return success over every cost, with the numbers of each point folded away; nothing without curves."""
    if not curves:
        return []
    numbers = {
        f"{curve.name}{f', run {number}' if len(curve.runs) > 1 else ''}, {one.name}": (
            f"{one.labels:,} labels, {format_seconds(one.seconds)}: {one.validation}"
        )
        for curve in curves
        for number, run in enumerate(curve.runs)
        for one in run
    }
    figures, note = curve_figures(curves, target), curve_note(curves)
    named = {"The curves in numbers": numbers}
    return [Section("Success against cost", figures=figures, tables=tables, notes=(note,), named=named)]


def disturbed_note(result: EvalResult) -> str:
    """Return a sentence on the conditions, behind a blank; empty without any."""
    disturbance = result.settings.disturbance
    return "" if disturbance == "none" else f" Disturbed: {disturbance}."


def phase_table(policies: Sequence[tuple[str, Sequence[EpisodeResult]]], task: str) -> Table | None:
    """Return failed episodes by the phase that they ended in, in the order of the task, a column a policy.

    policies: names and episodes. None if none failed or no phase is known.
    """
    counted = [Counter(e.phase_at_end or NOT_RECORDED for e in own if not e.success) for _, own in policies]
    found = {name for counts in counted for name in counts}
    if not found - {NOT_RECORDED}:
        return None
    meanings = phase_meanings(task)
    names = [*meanings, *sorted(found - meanings.keys())]
    rows = (
        (f"{_spaced(name)}\n{meanings.get(name, '')}".rstrip(), *(f"{counts[name]:,}" for counts in counted))
        for name in names
    )
    return Table(("phase that it ended in", *(name for name, _ in policies)), tuple(rows))


def phase_meanings(task: str) -> dict[str, str]:
    """Return phase -> meaning, from the first to the last; empty for a task that is not known here."""
    known = TASKS.get(task.partition(":")[0])
    return {rung.name: rung.words for rung in reversed(known.rungs)} | {NO_PHASE: _NO_PHASE} if known else {}


def evaluation_verdict(result: EvalResult) -> str:
    """Return the first sentence: success with its interval, and the phase that failures end in."""
    success, episodes = result.success, f"unseen episodes of {result.robot} {result.task}"
    failed, phase = success.n - success.successes, _main_phase(result)
    if not failed:
        return f"{result.policy} succeeds in all {success.n:,} {episodes}: {success}."
    if success.successes == 0:
        verdict = f"{result.policy} fails in all {success.n:,} {episodes}: {success}"
    else:
        verdict = f"{result.policy} succeeds in {success} of {success.n:,} {episodes}"
    if not phase:
        return f"{verdict}."
    share = f"{result.failures[phase]:,} of its {failed:,} failures end" if failed > 1 else "its one failure ends"
    return f"{verdict}; {share} in the phase {_spaced(phase)}."


def evaluation_facts(result: EvalResult) -> tuple[str, ...]:
    """Return further sentences: main phase, lowest condition, successes that did not last."""
    facts: list[str] = []
    if phase := _main_phase(result):
        meaning = phase_meanings(result.task).get(phase)
        facts += [f"{_spaced(phase).capitalize()}, where failures end most often: {meaning}."] if meaning else []
    elif result.failures:
        facts.append(f"The phase of failures is {NOT_RECORDED}.")
    rates = {name or NO_CONDITION: part.success for name, part in result.by_condition.items()}
    if len(rates) > 1 and result.failures:
        worst = min(rates, key=lambda name: rates[name].rate)
        facts.append(f"Of {len(rates)} conditions {worst} has the lowest success: {rates[worst]}.")
    if lost := sum(episode.success and not episode.success_at_end for episode in result.episodes):
        facts.append(f"{lost:,} of the episodes that succeeded were no longer at the goal in their last frame.")
    return tuple(facts)


def _conditions(result: EvalResult) -> Section:
    """Success in all episodes and in every condition, and what success and the conditions mean."""
    settings, parts = result.settings, result.by_condition
    table = evaluation_table(result)
    table, bars = replace(table, colours=(DAGGER,)), [Bar(result.policy, (result.success,))]
    if len(parts) > 1:
        (_, *total), *rows = table.rows
        named = (("all conditions", *total), *((row[0].strip(), *row[1:]) for row in rows))
        table = Table(("condition", *table.columns[1:]), named, (BASELINE, *[DAGGER] * len(rows)))
        bars = [Bar("all conditions", (result.success,), BASELINE)]
        bars += [Bar(name or NO_CONDITION, (part.success,)) for name, part in parts.items()]
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


def _no_films(why: str) -> tuple[str, ...]:
    return (f"No films: {why}",) if why else ()


def _main_phase(result: EvalResult) -> str:
    """The phase that most failures ended in; empty if none failed or no phase is known."""
    return next(filter(None, result.failures), "")


def _spaced(phase: str) -> str:
    return phase.replace("_", " ")
