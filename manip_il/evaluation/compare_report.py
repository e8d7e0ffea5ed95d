"""`report.html` of a comparison and of a study: which arm is better, where they differ, and what they cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from statistics import fmean
from typing import Any

from manip_il.evaluation.arm import Arm
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.eval_report import MAP_NOTE
from manip_il.evaluation.failures import map_groups, phase_table
from manip_il.evaluation.figures import ARMS, Bar, Curve, Figure, rates_figure
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import Report, Section, curve_section
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.study import Study, arms_table
from manip_il.evaluation.tables import BASELINE, CLONING, DAGGER, NO_CONDITION, Table

_COLOURS = (CLONING, DAGGER)  # left, right


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
    return Table(("condition", "episodes", *comparison.names, "difference"), tuple(rows)) if len(parts) > 1 else None


def compare_report(
    comparison: Comparison, command: str, facts: Sequence[str] = (), config: Mapping[str, Any] | None = None
) -> Report:
    """Return the report of a comparison. facts: sentences that follow the four counts of paired episodes."""
    first = comparison.left.members[0].test
    left, right = (arm.members[0].test.fingerprint for arm in comparison.arms)
    counts = ((pair.n, pair.both, pair.only_right, pair.only_left, pair.neither) for pair in comparison.pairs)
    n, both, only_right, only_left, neither = map(sum, zip(*counts, strict=True))
    over = f" of {len(comparison.pairs)} training seeds" if len(comparison.pairs) > 1 else ""
    a, b = comparison.names
    paired = (
        f"Of {n:,} paired episodes{over} both solved {both:,}, only {b} {only_right:,}, only {a} {only_left:,}, and "
        f"neither {neither:,}."
    )
    arms = zip(comparison.arms, _COLOURS, strict=True)
    curves = [_curve(arm, colour) for arm, colour in arms if all(member.history for member in arm.members)]
    sections = [_results(comparison, first), *_failures(comparison)]
    return Report(
        title=f"{' against '.join(comparison.names)}: {first.robot} {first.task}",
        verdict=comparison.verdict,
        facts=(paired, *facts),
        command=command,
        sections=(*sections, *([curve_section(curves)] if curves else [])),
        config=config or {},
        fingerprint=left if left == right else dict(zip(comparison.names, (left, right), strict=True)),
    )


def _results(comparison: Comparison, first: EvalResult) -> Section:
    bars = [_bar(arm, colour) for arm, colour in zip(comparison.arms, _COLOURS, strict=True)]
    note = f"Both ran the same {first.success.n:,} test episodes.{_disturbed(first)}{_dots(len(bars[0].successes) > 1)}"
    tables = filter(None, (comparison_table(comparison), condition_table(comparison)))
    return Section("Results", figures=(rates_figure(bars),), tables=tuple(tables), notes=(note,))


def _failures(comparison: Comparison) -> list[Section]:
    figures, first = paired_maps(comparison), comparison.left.members[0].test
    every = [(arm.name, [*chain(*(one.test.episodes for one in arm.members))]) for arm in comparison.arms]
    table = phase_table(every, first.task)
    notes = [MAP_NOTE] if figures else []
    if len(comparison.pairs) > 1:
        notes.append("Over training seeds, an episode counts for the side that failed in more of them.")
    if not figures and table is None:
        return []
    return [Section("Where they fail", figures=figures, tables=(table,) if table else (), notes=tuple(notes))]


def paired_maps(comparison: Comparison) -> tuple[Figure, ...]:
    """Draw test episodes by who failed in them: neither, both as often, or one side more often than the other."""
    failed: Counter[int] = Counter()
    for episode in chain(*(one.test.episodes for arm in comparison.arms for one in arm.members)):
        failed[episode.seed] += not episode.success
    episodes = comparison.left.members[0].test.episodes
    a, b = comparison.names
    margins = comparison.margins
    return map_groups(
        (
            ("solved by both", BASELINE, [one for one in episodes if not failed[one.seed]]),
            ("failed by both", "#5b636d", [one for one in episodes if failed[one.seed] and not margins[one.seed]]),
            (f"failed by {a}", _COLOURS[0], [one for one in episodes if margins[one.seed] > 0]),
            (f"failed by {b}", _COLOURS[1], [one for one in episodes if margins[one.seed] < 0]),
        )
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
    note = f"Every policy ran {same}{first.success.n:,} test episodes, on which nothing was chosen.{_disturbed(first)}"
    results, *others = (Table(one.columns, one.rows, tuple(colours.values())) for one in study.tables())
    bars = [_bar(arm, colours[arm.name]) for arm in study.arms]
    return Report(
        title=title,
        verdict=study.verdict,
        facts=tuple(study.facts),
        command=command,
        sections=(
            Section(
                "Results",
                figures=(rates_figure(bars),),
                tables=(results,),
                notes=(note + _dots(len(study.training_seeds) > 1),),
            ),
            curve_section([_curve(arm, colours[arm.name]) for arm in study.arms], study.target, tuple(others)),
        ),
        config=config or {},
        fingerprint=first.fingerprint,
        timings=timings,
    )


def arm_colours(study: Study) -> dict[str, str]:
    """Return arm -> its colour: the baseline grey, the others in order."""
    others = [arm.name for arm in study.arms if arm.name != study.baseline]
    found = {name: ARMS[place % len(ARMS)] for place, name in enumerate(others)}
    return {arm.name: found.get(arm.name, BASELINE) for arm in study.arms}


def _bar(arm: Arm, colour: str) -> Bar:
    return Bar(arm.name, tuple(member.test.success for member in arm.members), colour)


def _curve(arm: Arm, colour: str) -> Curve:
    return Curve(arm.name, tuple(member.history for member in arm.members), colour)


def _disturbed(result: EvalResult) -> str:
    disturbance = result.settings.disturbance
    return "" if disturbance == "none" else f" Disturbed: {disturbance}."


def _dots(several: bool) -> str:
    return " In brackets and as dots: each training seed; the bar is their mean." if several else ""
