"""`report.html` of a study: who is better, and success over labels, episodes and wall-clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from manip_il.evaluation import curve_sections, sections
from manip_il.evaluation.charts import seeds_bar
from manip_il.evaluation.comparison import Arm, Measured
from manip_il.evaluation.html_table import cells_table
from manip_il.evaluation.report import render_page
from manip_il.evaluation.report_data import ArmCurve
from manip_il.evaluation.rounds import curve_points
from manip_il.evaluation.study import Study

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
    """Return the page as one string of HTML."""
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
        cells_table(study.results_table(), kinds),
        sections.bars(drawn),
        f'<p class="note">{sections.prose(" ".join(note))}</p>',
    )


def _curves(study: Study) -> str:
    kinds = arm_kinds(study)
    arms = [(arm_curve(arm), kinds[arm.name]) for arm in study.arms]
    return sections.section(
        "Success against cost",
        curve_sections.arm_curves(arms, study.target),
        cells_table(study.target_table(), kinds),
        sections.details("The curves in numbers", sections.pairs(arm_numbers(study.arms))),
    )


def arm_kinds(study: Study) -> dict[str, str]:
    """Arm -> the CSS class of its colour: the baseline grey, the others in order."""
    others = [arm.name for arm in study.arms if arm.name != study.baseline]
    return {study.baseline: "arm base"} | {name: f"arm arm-{i % COLOURS}" for i, name in enumerate(others)}


def arm_curve(arm: Arm) -> ArmCurve:
    """Return its members' runs; `ManipError` where one is of no run."""
    return ArmCurve(arm.name, tuple(curve_points(member.history) for member in arm.members))


def arm_numbers(arms: Sequence[Arm]) -> dict[str, str]:
    """Return every round of every run in words, and its validation."""
    return {
        f"{arm.name}{_seed(member)}, {one.words}": str(one.validation)
        for arm in arms
        for member in arm.members
        for one in member.history
    }


def _seed(member: Measured) -> str:
    return "" if member.training_seed is None else f", training seed {member.training_seed}"
