"""`report.html` of a comparison and of a study: which arm is better, in which phases they fail, and what they cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from statistics import fmean
from typing import Any

from manip_il.evaluation.arm import Arm
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.eval_report import curve_sections, disturbed_note, failures_sections
from manip_il.evaluation.figures import ARMS, Bar, Curve, rates_figure
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.study import Study, arms_table
from manip_il.evaluation.tables import BASELINE, CLONING, DAGGER, NO_CONDITION, Table

_COLOURS = (CLONING, DAGGER)  # left, right


def compare_report(
    comparison: Comparison, command: str, facts: Sequence[str] = (), config: Mapping[str, Any] | None = None
) -> Report:
    """Return the report of a comparison. facts: sentences that follow the four counts of paired episodes."""
    first = comparison.left.members[0].test
    left, right = (arm.members[0].test.fingerprint for arm in comparison.arms)
    counts = ((pair.n, pair.both, pair.only_right, pair.only_left, pair.neither) for pair in comparison.pairs)
    n, both, only_right, only_left, neither = map(sum, zip(*counts, strict=True))
    over = f" of {len(comparison.pairs)} training seeds" if len(comparison.pairs) > 1 else ""
    names = a, b = comparison.left.name, comparison.right.name
    paired = (
        f"Of {n:,} paired episodes{over} both solved {both:,}, only {b} {only_right:,}, only {a} {only_left:,}, and "
        f"neither {neither:,}."
    )
    curves = [_curve(arm, colour) for arm, colour in zip(comparison.arms, _COLOURS, strict=True) if arm.has_histories]
    episodes = [(arm.name, [*chain(*(one.test.episodes for one in arm.members))]) for arm in comparison.arms]
    tables = tuple(filter(None, (comparison_table(comparison), condition_table(comparison))))
    note = f"Both ran the same {first.success.n:,} test episodes.{disturbed_note(first)}"
    return Report(
        title=f"{' against '.join(names)}: {first.robot} {first.task}",
        verdict=comparison.verdict,
        facts=(paired, *facts),
        command=command,
        sections=(
            _results(comparison.arms, _COLOURS, tables, note),
            *failures_sections(episodes, first.task, "Where they fail"),
            *curve_sections(curves),
        ),
        config=config or {},
        fingerprint=left if left == right else dict(zip(names, (left, right), strict=True)),
    )


def study_report(study: Study, title: str, command: str, config: Mapping[str, Any] | None = None) -> Report:
    """Return the report of a study."""
    colours = arm_colours(study)
    timings: dict[str, float] = {}
    for arm in study.arms:
        for member in arm.members:
            last, name = member.history[-1], f"{arm.name}, training seed {member.training_seed}"
            timings |= {f"{name}, collect and fit": last.seconds, f"{name}, validate": last.validating}
    first = study.arms[0].members[0].test
    same = "the same " if study.baseline is not None else ""
    note = (
        f"Every policy ran {same}{first.success.n:,} test episodes, on which nothing was chosen.{disturbed_note(first)}"
    )
    results, *others = (Table(one.columns, one.rows, tuple(colours.values())) for one in study.tables())
    curves = [_curve(arm, colours[arm.name]) for arm in study.arms]
    return Report(
        title=title,
        verdict=study.verdict,
        facts=tuple(study.facts),
        command=command,
        sections=(
            _results(study.arms, tuple(colours.values()), (results,), note),
            *curve_sections(curves, study.target, tuple(others)),
        ),
        config=config or {},
        fingerprint=first.fingerprint,
        timings=timings,
    )


def comparison_table(comparison: Comparison) -> Table:
    """Return an arm a row, see `arms_table`."""
    table = arms_table(comparison.arms, {comparison.right.name: comparison})
    return Table(table.columns, table.rows, _COLOURS)


def condition_table(comparison: Comparison) -> Table | None:
    """Return success of both arms by condition, the mean over training seeds; None if there is one condition alone."""
    parts = comparison.left.members[0].test.by_condition
    rows: list[tuple[str, ...]] = []
    for name, part in parts.items():
        left, right = (fmean(m.test.by_condition[name].success.rate for m in arm.members) for arm in comparison.arms)
        cells = (format_percent(left), format_percent(right), f"{100 * (right - left):+.1f} points")
        rows.append((name or NO_CONDITION, f"{part.success.n:,}", *cells))
    head = ("condition", "episodes", comparison.left.name, comparison.right.name, "difference")
    return Table(head, tuple(rows)) if len(parts) > 1 else None


def arm_colours(study: Study) -> dict[str, str]:
    """Return arm -> its colour: the baseline grey, the others in order."""
    others = [arm.name for arm in study.arms if arm.name != study.baseline]
    found = {name: ARMS[place % len(ARMS)] for place, name in enumerate(others)}
    return {arm.name: found.get(arm.name, BASELINE) for arm in study.arms}


def _results(arms: Sequence[Arm], colours: Sequence[str], tables: tuple[Table, ...], note: str) -> Section:
    rates = [tuple(member.test.success for member in arm.members) for arm in arms]
    bars = [Bar(arm.name, own, colour) for arm, own, colour in zip(arms, rates, colours, strict=True)]
    if len(rates[0]) > 1:
        note += " In brackets and as dots: each training seed; the bar is their mean."
    return Section("Results", figures=(rates_figure(bars),), tables=tables, notes=(note,))


def _curve(arm: Arm, colour: str) -> Curve:
    return Curve(arm.name, tuple(member.history for member in arm.members), colour)
