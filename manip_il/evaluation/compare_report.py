"""The tables of a comparison, and its `report.html`: which is better, and in which episodes the two differ."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import fmean
from typing import Any, ClassVar

from manip_il.evaluation.comparison import Comparison, Member
from manip_il.evaluation.curves import CurveCharts
from manip_il.evaluation.eval_report import AXES_NOTE
from manip_il.evaluation.failures import PhaseRow, phase_rows
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.maps import FailureMap, Outcome, paired_maps
from manip_il.evaluation.report import Bar, Report
from manip_il.evaluation.report_data import format_seconds
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.significance import format_p, format_p_cell, holm, sign_flip_exact
from manip_il.evaluation.study_report import arm_series
from manip_il.evaluation.tables import NO_CONDITION, Table

KINDS = ("arm arm-1 left", "arm arm-0 right")  # left, right


def comparison_table(comparison: Comparison) -> Table:
    """Return two rows a training seed, the paired result on the second."""
    columns = ("policy", "training seed", "round", "labels", "episodes", "wall-clock", "validation")
    columns += (f"test [{100 * comparison.confidence:g} % interval]", "difference", "McNemar's exact p")
    rows: list[tuple[str, ...]] = []
    members = zip(comparison.left.members, comparison.right.members, comparison.pairs, strict=True)
    for left, right, pair in members:
        low, high = (100 * end for end in pair.interval)
        difference = f"{100 * pair.difference:+.1f} points [{low:+.1f}, {high:+.1f}]"
        rows += [(*_cells(left), "", ""), (*_cells(right), difference, format_p_cell(pair.p_value))]
    return Table(columns, tuple(rows), KINDS * len(comparison.pairs))


def condition_table(comparison: Comparison) -> Table | None:
    """Return both arms by condition, all training seeds together; None where there is one condition alone.

    p: exact over test episodes as in `Comparison.p_value`, corrected for the number of conditions (Holm).
    """
    parts = comparison.left.members[0].result.by_condition
    if len(parts) < 2:
        return None
    left, right = _outcomes(comparison.left.members), _outcomes(comparison.right.members)
    seeds = {name: [episode.seed for episode in part.episodes] for name, part in parts.items()}
    margins = [[sum(right[seed]) - sum(left[seed]) for seed in own] for own in seeds.values()]
    corrected = holm([sign_flip_exact(one) for one in margins])
    rows: list[tuple[str, ...]] = []
    for (name, own), p in zip(seeds.items(), corrected, strict=True):
        rates = [fmean(success for seed in own for success in outcomes[seed]) for outcomes in (left, right)]
        difference = f"{100 * (rates[1] - rates[0]):+.1f} points"
        rows.append((name or NO_CONDITION, f"{len(own):,}", *map(format_percent, rates), difference, format_p(p)))
    return Table(("condition", "episodes", *comparison.names, "difference", "corrected p"), tuple(rows))


def compare_report(
    comparison: Comparison, command: str, facts: Sequence[str] = (), config: Mapping[str, Any] | None = None
) -> CompareReport:
    """Return the report of a comparison. facts: sentences that follow the four counts of paired episodes."""
    first = comparison.left.members[0].result
    left, right = (arm.members[0].result.fingerprint for arm in comparison.arms)
    return CompareReport(
        title=f"{' against '.join(comparison.names)}: {first.robot} {first.task}",
        verdict=comparison.verdict,
        facts=(_paired_fact(comparison), *facts),
        command=command,
        config=config or {},
        fingerprint=left if left == right else dict(zip(comparison.names, (left, right), strict=True)),
        comparison=comparison,
    )


@dataclass(frozen=True, kw_only=True)
class CompareReport(Report):
    """The report of a comparison, made by `compare_report`."""

    template: ClassVar[str] = "compare.html.j2"
    kinds: ClassVar[tuple[str, str]] = KINDS
    comparison: Comparison

    @property
    def _first(self) -> EvalResult:
        return self.comparison.left.members[0].result

    @property
    def _several(self) -> bool:
        return len(self.comparison.pairs) > 1

    @property
    def bars(self) -> list[Bar]:
        """Success of both arms."""
        arms = zip(self.comparison.arms, KINDS, strict=True)
        return [Bar.of(arm.name, kind, *(member.result.success for member in arm.members)) for arm, kind in arms]

    @property
    def note(self) -> str:
        """Number of episodes, the disturbance, meaning of dots."""
        note = f"Both ran the same {self._first.success.n:,} test episodes."
        if self._first.settings.disturbance != "none":
            note += f" Disturbed: {self._first.settings.disturbance}."
        return note + (" Dots: each training seed; the bar is their mean." if self._several else "")

    @property
    def table(self) -> Table:
        """The table without p, which stands beside the counts that it follows from."""
        table = comparison_table(self.comparison)
        return replace(table, columns=table.columns[:-1], rows=tuple(row[:-1] for row in table.rows))

    @property
    def paired_table(self) -> Table:
        """Counts of paired episodes by who succeeded."""
        a, b = self.comparison.names
        rows = [
            (
                f"training seed {left.training_seed}" if self._several else "test episodes",
                *(f"{count:,}" for count in (pair.n, pair.both, pair.only_left, pair.only_right, pair.neither)),
                format_p_cell(pair.p_value),
            )
            for left, pair in zip(self.comparison.left.members, self.comparison.pairs, strict=True)
        ]
        columns = ("", "episodes", "both solved", f"only {a}", f"only {b}", "neither", "McNemar's exact p")
        return Table(columns, tuple(rows))

    @cached_property
    def condition_table(self) -> Table | None:
        """Both arms by condition."""
        return condition_table(self.comparison)

    @cached_property
    def maps(self) -> list[FailureMap]:
        """Starts and goals of both arms; empty where episodes lack them."""
        return paired_maps(self.comparison)

    @property
    def map_names(self) -> dict[Outcome, str]:
        """Outcomes in words."""
        more = " (in more training seeds than the other)" if self._several else ""
        return {
            "failed": f"only this one failed{more}",
            "shared": "failed, and so did the other",
            "solved": f"solved: {self.maps[0].moving}'s start (circle) and goal (square)",
        }

    @property
    def map_note(self) -> str:
        """Axes of the maps."""
        return f"Both maps show the same starts and goals. {AXES_NOTE}. {self.maps[0].thinning_note}"

    @cached_property
    def phases(self) -> tuple[PhaseRow, ...]:
        """Failed episodes of both arms by phase; empty where none failed or no phase is known."""
        episodes = [[e for member in arm.members for e in member.result.episodes] for arm in self.comparison.arms]
        if not any(e.phase_at_end and not e.success for arm in episodes for e in arm):
            return ()
        return phase_rows(episodes, self._first.task)

    @property
    def phases_note(self) -> str:
        """Order of phases and bars."""
        seeds = ", all training seeds together" if self._several else ""
        return f"Failed episodes{seeds}, in the order of the task; the upper bar is {self.comparison.left.name}."

    @cached_property
    def curves(self) -> CurveCharts | None:
        """Success against cost of the arms whose policies are all of runs; None without such an arm."""
        arms = zip(self.comparison.arms, KINDS, strict=True)
        series = tuple(arm_series(arm, kind) for arm, kind in arms if all(member.history for member in arm.members))
        return CurveCharts(series) if series else None


def _paired_fact(comparison: Comparison) -> str:
    counts = ((pair.n, pair.both, pair.only_right, pair.only_left, pair.neither) for pair in comparison.pairs)
    n, both, right, left, neither = map(sum, zip(*counts, strict=True))
    over = f" of {len(comparison.pairs)} training seeds" if len(comparison.pairs) > 1 else ""
    a, b = comparison.names
    only = f"only {b} {right:,}, only {a} {left:,}"
    return f"Of {n:,} paired episodes{over} both solved {both:,}, {only}, and neither {neither:,}."


def _cells(member: Member) -> tuple[str, ...]:
    seed, one, costs = "" if member.training_seed is None else str(member.training_seed), member.chosen, ("",) * 5
    if one is not None:
        costs = (str(one.round), f"{one.labels:,}", f"{one.episodes:,}", format_seconds(one.seconds))
        costs += (format_percent(one.validation.rate),)
    return (member.name, seed, *costs, str(member.result.success))


def _outcomes(members: Sequence[Member]) -> dict[int, list[bool]]:
    """Test seed -> success of each training seed."""
    outcomes: defaultdict[int, list[bool]] = defaultdict(list)
    for episode in (one for member in members for one in member.result.episodes):
        outcomes[episode.seed].append(episode.success)
    return outcomes
