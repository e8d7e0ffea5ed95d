"""`report.html` of a study: which arm is better, and success over labels, episodes, steps and wall-clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

from manip_il.evaluation.comparison import Arm
from manip_il.evaluation.curves import CurveCharts, Series
from manip_il.evaluation.report import Bar, Report
from manip_il.evaluation.rounds import curve_points
from manip_il.evaluation.study import Study
from manip_il.evaluation.tables import Table

COLOURS = 7  # besides the baseline's; arms beyond differ by their marks


def study_report(study: Study, title: str, command: str, config: Mapping[str, Any] | None = None) -> StudyReport:
    """Return the report of a study."""
    timings: dict[str, float] = {}
    for arm in study.arms:
        for member in arm.members:
            last, name = member.history[-1], f"{arm.name}, training seed {member.training_seed}"
            timings |= {f"{name}, collect and fit": last.seconds, f"{name}, validate": last.validating}
    return StudyReport(
        title=title,
        verdict=study.verdict,
        facts=tuple(study.facts),
        command=command,
        config=config or {},
        fingerprint=study.arms[0].members[0].result.fingerprint,
        timings=timings,
        study=study,
    )


@dataclass(frozen=True, kw_only=True)
class StudyReport(Report):
    """The report of a study, made by `study_report`."""

    template: ClassVar[str] = "study.html.j2"
    study: Study

    @property
    def kinds(self) -> dict[str, str]:
        """Arm -> CSS class of its colour: the baseline grey, the others in order."""
        others = [arm.name for arm in self.study.arms if arm.name != self.study.baseline]
        base = {} if self.study.baseline is None else {self.study.baseline: "arm base"}
        return base | {name: f"arm arm-{i % COLOURS}" for i, name in enumerate(others)}

    @property
    def results(self) -> Table:
        """Costs and success of each arm."""
        return self._coloured(self.study.results_table())

    @property
    def to_target(self) -> Table:
        """Costs of each arm to the target."""
        return self._coloured(self.study.target_table())

    @property
    def within(self) -> Table | None:
        """Success of each arm within costs that were asked for."""
        return self._coloured(self.study.within_table()) if self.study.within else None

    @property
    def bars(self) -> list[Bar]:
        """Success of each arm."""
        return [
            Bar.of(arm.name, self.kinds[arm.name], *(member.result.success for member in arm.members))
            for arm in self.study.arms
        ]

    @property
    def note(self) -> str:
        """Number of episodes, the disturbance, meaning of brackets and dots."""
        first = self.study.arms[0].members[0].result
        same = "the same " if self.study.baseline is not None else ""
        note = f"Every policy ran {same}{first.success.n:,} test episodes, on which nothing was chosen."
        if first.settings.disturbance != "none":
            note += f" Disturbed: {first.settings.disturbance}."
        if len(self.study.training_seeds) > 1:
            note += " In brackets and as dots: each training seed; the bar is their mean."
        return note

    @cached_property
    def curves(self) -> CurveCharts:
        """Success against cost."""
        series = tuple(arm_series(arm, self.kinds[arm.name]) for arm in self.study.arms)
        return CurveCharts(series, self.study.target)

    def _coloured(self, table: Table) -> Table:
        return replace(table, kinds=tuple(self.kinds[row[0]] for row in table.rows))


def arm_series(arm: Arm, kind: str) -> Series:
    """Return the runs of an arm's members; `ManipError` where one is of no run."""
    runs = {
        "" if member.training_seed is None else f"training seed {member.training_seed}": curve_points(member.history)
        for member in arm.members
    }
    return Series(arm.name, kind, runs)
