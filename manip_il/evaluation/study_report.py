"""`report.html` of a study: who is better, and success over labels, episodes and wall-clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from manip_il.evaluation import curve_sections, sections
from manip_il.evaluation.charts import seeds_bar
from manip_il.evaluation.comparison import Arm
from manip_il.evaluation.curve_charts import SHAPES, across, study_curve, success_axis
from manip_il.evaluation.report import render_page
from manip_il.evaluation.report_data import COSTS, ArmCurve, format_percent
from manip_il.evaluation.rounds import curve_points
from manip_il.evaluation.study import Study
from manip_il.evaluation.svg import element
from manip_il.evaluation.tables import Cells

COLOURS = 7  # besides the baseline's; arms beyond differ by their marks


@dataclass(frozen=True)
class StudyReport:
    """A study's whole story. command: what made it; config, fingerprint: nested mappings."""

    title: str
    command: str
    study: Study
    config: Mapping[str, Any] = field(default_factory=dict[str, Any])
    fingerprint: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def verdict(self) -> str:
        """The first sentence."""
        return self.study.verdict

    @property
    def facts(self) -> Sequence[str]:
        """Further sentences under it."""
        return self.study.facts

    @property
    def timings(self) -> Mapping[str, float]:
        """What every run took, measuring it included [s]."""
        timings: dict[str, float] = {}
        for arm in self.study.arms:
            for member in arm.members:
                last, name = member.history[-1], f"{arm.name}, training seed {member.training_seed}"
                timings |= {f"{name}, collect and fit": last.seconds, f"{name}, validate": last.validating}
        return timings


def render_study(report: StudyReport) -> str:
    """The page as one string of HTML."""
    study = report.study
    return render_page(
        report.title, [sections.header(report), _results(study), _curves(study), sections.making(report)]
    )


def _results(study: Study) -> str:
    kinds = arm_kinds(study)
    drawn = [
        (arm.name, seeds_bar(arm.name, kinds[arm.name], [m.result.success for m in arm.members]), arm.test_rate)
        for arm in study.arms
    ]
    first = study.arms[0].members[0].result
    count = len(study.training_seeds)
    note = [f"Every policy ran the same {first.success.n:,} test episodes, on which nothing was chosen."]
    if first.settings.disturbance != "none":
        note.append(f"Disturbed: {first.settings.disturbance}.")
    if count > 1:
        note.append("In brackets and as dots: each training seed; the bar is their mean.")
    return sections.section(
        "Results",
        _table(study.results_table(), kinds),
        sections.bars(drawn),
        f'<p class="note">{sections.prose(" ".join(note))}</p>',
    )


def _curves(study: Study) -> str:
    kinds = arm_kinds(study)
    arms = [(_curve(arm), kinds[arm.name]) for arm in study.arms]
    keys = [f"<li>{_key(index, kinds[arm.name])}{escape(arm.name)}</li>" for index, arm in enumerate(study.arms)]
    keys.append(f'<li><i class="key target"></i>target, {format_percent(study.target)}</li>')
    points = [point for arm, _ in arms for point in arm.points]
    drawn = [
        (study_curve(arms, cost, study.target), across(cost, [point.amount(cost) or 0 for point in points]).words)
        for cost in COSTS
    ]
    several = len(study.training_seeds) > 1
    words = "Validation success by round, the mean over training seeds; thin lines are the seeds."
    single = "Validation success by round; bars are 95 % intervals."
    y = success_axis([point.success for point in points], study.target)
    return sections.section(
        "What success cost",
        curve_sections.curve_note(words if several else single, y, timed=True),
        f'<ul class="legend">{"".join(keys)}</ul>',
        curve_sections.plots(drawn),
        _table(study.target_table(), kinds),
        sections.details("The curves in numbers", sections.pairs(_numbers(study))),
    )


def arm_kinds(study: Study) -> dict[str, str]:
    """Arm -> the CSS class of its colour: the baseline grey, the others in order."""
    others = [arm.name for arm in study.arms if arm.name != study.baseline]
    return {study.baseline: "arm base"} | {name: f"arm arm-{i % COLOURS}" for i, name in enumerate(others)}


def _curve(arm: Arm) -> ArmCurve:
    return ArmCurve(arm.name, tuple(curve_points(member.history) for member in arm.members))


def _numbers(study: Study) -> dict[str, str]:
    return {
        f"{arm.name}, training seed {member.training_seed}, {one.words}": str(one.validation)
        for arm in study.arms
        for member in arm.members
        for one in member.history
    }


def _key(index: int, kind: str) -> str:
    shape = element("g", SHAPES[index % len(SHAPES)], class_=f"series {kind}")
    return element("svg", shape, class_="key-mark", viewBox="-8 -8 16 16", aria_hidden="true")


def _table(cells: Cells, kinds: Mapping[str, str]) -> str:
    cells = cells.filled()
    name = cells.columns[0].partition(",")[0]
    head = "".join(
        f'<th scope="col" role="columnheader">{escape(text)}</th>' for text in map(_capital, (name, *cells.columns[1:]))
    )
    body = "".join(
        f'<tr role="row"><th scope="row" role="rowheader"><i class="key {kinds[row[0]]}"></i>{escape(row[0])}</th>'
        + "".join(
            f'<td role="cell" data-label="{escape(_capital(column))}">{_cell(text)}</td>'
            for column, text in zip(cells.columns[1:], row[1:], strict=True)
        )
        + "</tr>"
        for row in cells.rows
    )
    return (
        f'<table class="results wide" role="table"><thead role="rowgroup"><tr role="row">{head}</tr></thead>'
        f'<tbody role="rowgroup">{body}</tbody></table>'
    )


def _cell(text: str) -> str:
    """A number, and softer what stands behind it in brackets."""
    if not text:
        return sections.NOT_MEASURED
    for opening in (" [", " ("):
        number, bracket, rest = text.partition(opening)
        if bracket:
            behind = f'<span class="interval">{sections.prose(bracket.strip() + rest)}</span>'
            return f"<span><span>{sections.prose(number)}</span> {behind}</span>"
    parts = [f"<span>{sections.prose(part)}</span>" for part in text.replace(", ", ",\n").split("\n")]
    return f"<span>{' '.join(parts)}</span>"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
