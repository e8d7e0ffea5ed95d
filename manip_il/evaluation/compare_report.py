"""`report.html` of a comparison: which is better, and in which episodes the two differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from manip_il.errors import ManipError
from manip_il.evaluation import curve_sections, sections
from manip_il.evaluation.charts import seeds_bar
from manip_il.evaluation.comparison import Arm, Comparison
from manip_il.evaluation.comparison_table import comparison_table
from manip_il.evaluation.condition_chart import paired_conditions
from manip_il.evaluation.episode_facts import has_object
from manip_il.evaluation.failure_map import failure_map, map_legend, thinning_note
from manip_il.evaluation.html_table import cells_table
from manip_il.evaluation.paired_map import paired_marks
from manip_il.evaluation.phase_chart import phase_chart, phase_rows
from manip_il.evaluation.report import render_page
from manip_il.evaluation.report_data import Film, Paths, Strip
from manip_il.evaluation.statistics import format_p
from manip_il.evaluation.study_report import arm_curve, arm_numbers
from manip_il.evaluation.tables import Cells

KINDS = ("arm arm-1 left", "arm arm-0 right")  # left, right


@dataclass(frozen=True)
class CompareReport:
    """A comparison's whole story. Empty parts are left out of the page.

    command: what made it. more_facts: sentences under the verdict. films, strips, paths: of single episodes.
    timings: what -> [s]. config: nested.
    """

    comparison: Comparison
    command: str
    more_facts: tuple[str, ...] = ()
    config: Mapping[str, Any] = field(default_factory=dict[str, Any])
    films: tuple[Film, ...] = ()
    strips: tuple[Strip, ...] = ()
    paths: tuple[Paths, ...] = ()
    pictures_note: str = ""
    timings: Mapping[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        if not self.command.strip():
            raise ManipError(f"report on {' and '.join(self.comparison.names)}: command is empty")

    @property
    def title(self) -> str:
        """What it is about."""
        first = self.comparison.left.members[0].result
        return f"{' against '.join(self.comparison.names)}: {first.robot} {first.task}"

    @property
    def verdict(self) -> str:
        """The first sentence."""
        return self.comparison.verdict

    @property
    def facts(self) -> Sequence[str]:
        """Further sentences under it."""
        return [_paired_fact(self.comparison), *self.more_facts]

    @property
    def fingerprint(self) -> Mapping[str, Any]:
        """Of both sides, where they differ; else the one that they share."""
        left, right = (arm.members[0].result.fingerprint for arm in (self.comparison.left, self.comparison.right))
        return left if left == right else dict(zip(self.comparison.names, (left, right), strict=True))


def compare_page(report: CompareReport) -> str:
    """Return the page as one string of HTML."""
    comparison = report.comparison
    return render_page(
        report.title,
        [
            sections.header(report),
            _results(comparison),
            _conditions(comparison),
            _where(comparison),
            _curves(comparison),
            sections.pictures(report),
            sections.making(report),
        ],
    )


def _arms(comparison: Comparison) -> tuple[Arm, Arm]:
    return comparison.left, comparison.right


def _results(comparison: Comparison) -> str:
    arms = _arms(comparison)
    drawn = [
        (arm.name, seeds_bar(arm.name, kind, [m.result.success for m in arm.members]), arm.test_rate)
        for arm, kind in zip(arms, KINDS, strict=True)
    ]
    kinds = {member.name: kind for arm, kind in zip(arms, KINDS, strict=True) for member in arm.members}
    first = arms[0].members[0].result
    table = comparison_table(comparison)  # its last column, p, stands with the episodes that it is worked out from
    note = [f"Both ran the same {first.success.n:,} test episodes."]
    if first.settings.disturbance != "none":
        note.append(f"Disturbed: {first.settings.disturbance}.")
    if len(comparison.pairs) > 1:
        note.append("Dots: each training seed; the bar is their mean.")
    return sections.section(
        "Results",
        sections.bars(drawn),
        f'<p class="note">{sections.prose(" ".join(note))}</p>',
        cells_table(Cells(table.columns[:-1], tuple(row[:-1] for row in table.rows)), kinds),
        "<h3>Episode by episode</h3>",
        cells_table(_paired_table(comparison)),
    )


def _paired_fact(comparison: Comparison) -> str:
    both, left, right, neither = (
        sum(getattr(pair, count) for pair in comparison.pairs)
        for count in ("both", "only_left", "only_right", "neither")
    )
    total = sum(pair.n for pair in comparison.pairs)
    over = f" of {len(comparison.pairs)} training seeds" if len(comparison.pairs) > 1 else ""
    a, b = comparison.names
    return (
        f"Of {total:,} paired episodes{over} both solved {both:,}, only {b} {right:,}, only {a} {left:,}, "
        f"and neither {neither:,}."
    )


def _paired_table(comparison: Comparison) -> Cells:
    a, b = comparison.names
    several = len(comparison.pairs) > 1
    rows = [
        (
            f"training seed {left.training_seed}" if several else "test episodes",
            *(f"{count:,}" for count in (pair.n, pair.both, pair.only_left, pair.only_right, pair.neither)),
            format_p(pair.p_value).removeprefix("p ").removeprefix("= "),
        )
        for left, pair in zip(comparison.left.members, comparison.pairs, strict=True)
    ]
    columns = ("", "episodes", "both solved", f"only {a}", f"only {b}", "neither", "McNemar's exact p")
    return Cells(columns, tuple(rows))


def _conditions(comparison: Comparison) -> str:
    cells = paired_conditions(comparison)
    if cells is None:
        return ""
    note = "p: exact over the paired episodes of a condition, corrected for the number of conditions (Holm)."
    return sections.section(
        "By condition", cells_table(cells, names=comparison.names), f'<p class="note">{sections.prose(note)}</p>'
    )


def _where(comparison: Comparison) -> str:
    parts = [_maps(comparison), _phases(comparison)]
    return sections.section("Where they fail", *parts) if any(parts) else ""


def _maps(comparison: Comparison) -> str:
    both = paired_marks(comparison)
    marks = [*both[0], *both[1]]
    if not all(both):
        return ""
    thing = "object" if has_object(comparison.left.members[0].result) else "hand"
    maps = "".join(
        f'<figure class="{kind}"><figcaption><b>{escape(name)}</b></figcaption>'
        f"{failure_map(one, name, stacked=True)}</figure>"
        for name, kind, one in zip(comparison.names, KINDS, both, strict=True)
    )
    more = " (in more training seeds than the other)" if len(comparison.pairs) > 1 else ""
    legend = map_legend(
        marks,
        {
            "failed": f"only this one failed{more}",
            "shared": "failed, and so did the other",
            "solved": f"solved: {thing}'s start (circle) and goal (square)",
        },
        thing,
    )
    note = ["Both maps show the same starts and goals. x leads away from the robot, y to its left."]
    note += filter(None, [thinning_note(both[0])])
    return f'<div class="pair">{maps}</div>{legend}<p class="note">{sections.prose(" ".join(note))}</p>'


def _phases(comparison: Comparison) -> str:
    episodes = [[e for member in arm.members for e in member.result.episodes] for arm in _arms(comparison)]
    if not any(e.phase_at_end and not e.success for arm in episodes for e in arm):
        return ""
    rows = phase_rows(episodes, comparison.left.members[0].result.task)
    keys = "".join(
        f'<li><i class="key {kind}"></i>{escape(name)}</li>' for kind, name in zip(KINDS, comparison.names, strict=True)
    )
    seeds = ", all training seeds together" if len(comparison.pairs) > 1 else ""
    words = f"Failed episodes{seeds}, in the order of the task; the upper bar is {comparison.left.name}."
    return (
        f'<h3>The phase that they ended in</h3><ul class="legend">{keys}</ul>'
        f'{phase_chart(rows, KINDS, comparison.names)}<p class="note">{sections.prose(words)}</p>'
    )


def _curves(comparison: Comparison) -> str:
    arms = [
        (arm, kind)
        for arm, kind in zip(_arms(comparison), KINDS, strict=True)
        if all(member.history for member in arm.members)
    ]
    if not arms:
        return ""
    return sections.section(
        "Success against cost",
        curve_sections.arm_curves([(arm_curve(arm), kind) for arm, kind in arms]),
        sections.details("The curves in numbers", sections.pairs(arm_numbers([arm for arm, _ in arms]))),
    )
