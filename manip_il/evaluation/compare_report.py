"""`report.html` of a comparison and of a study: which arm is better, in which phases they fail, and what they cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import chain
from typing import Any

from manip_il.evaluation.comparison import Study
from manip_il.evaluation.eval_report import curve_sections, disturbed_note, failures_sections
from manip_il.evaluation.figures import ARMS, Bar, Curve, rates_figure
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import BASELINE


def compare_report(study: Study, title: str, command: str, config: Mapping[str, Any] | None = None) -> Report:
    """Return the report of arms beside each other."""
    colours = arm_colours(study)
    first = study.arms[0].members[0].test
    of_arms = tuple(colours.values())
    results, *conditions = study.result_tables()
    results, costs = replace(results, colours=of_arms), [replace(one, colours=of_arms) for one in study.cost_tables()]
    bars = [Bar(arm.name, tuple(one.test.success for one in arm.members), colours[arm.name]) for arm in study.arms]
    same = "the same " if study.baseline is not None else ""
    note = f"Every policy ran {same}{first.success.n:,} test episodes, on which nothing was chosen."
    note += disturbed_note(first)
    if len(bars[0].successes) > 1:
        note += " In brackets and as dots: each training seed; the bar is their mean."
    sections = [Section("Results", figures=(rates_figure(bars),), tables=(results, *conditions), notes=(note,))]
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


def arm_colours(study: Study) -> dict[str, str]:
    """Return arm -> its colour: the baseline grey, the others in order."""
    others = [arm.name for arm in study.arms if arm.name != study.baseline]
    found = {name: ARMS[place % len(ARMS)] for place, name in enumerate(others)}
    return {arm.name: found.get(arm.name, BASELINE) for arm in study.arms}
