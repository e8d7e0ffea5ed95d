"""A study: several arms with the same training seeds, compared with a baseline, and their costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import fmean
from typing import Any

from manip_il.evaluation.arm import Arm
from manip_il.evaluation.comparison import Comparison, seeds_facts
from manip_il.evaluation.intervals import Proportion, format_percent
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.rounds import COSTS, Cost, Round, Rule, format_amount, has_unqueried_steps, largest_dip
from manip_il.evaluation.tables import Table

FILE_NAME = "study.json"


@dataclass(frozen=True)
class Study:
    """All arms' runs with their tests. baseline: the arm that the others are compared with. target: in (0, 1].

    rule, limit: by which a run's round was chosen. Every member is of a run, and has its history. Arms of different
    tasks have no baseline (None). experts: tests of the expert in an arm's task, arm -> name of the test -> result.
    within: costs up to which validation is told.
    """

    arms: tuple[Arm, ...]
    baseline: str | None
    target: float
    rule: Rule
    limit: float | None = None
    experts: Mapping[str, Mapping[str, EvalResult]] = field(default_factory=dict)
    within: tuple[Rule, ...] = ()

    @property
    def training_seeds(self) -> list[int | None]:
        """Training seeds, the same in every arm."""
        return self.arms[0].training_seeds

    @cached_property
    def comparisons(self) -> dict[str, Comparison]:
        """Arm -> its comparison with the baseline, for every other arm; empty if there is no baseline."""
        if self.baseline is None:
            return {}
        [baseline] = [arm for arm in self.arms if arm.name == self.baseline]
        return {arm.name: Comparison(baseline, arm) for arm in self.arms if arm is not baseline}

    @property
    def verdict(self) -> str:
        """The first sentence: success of the best arm, and of the baseline, or of the second if that is best.

        Of arms without a baseline: how many reach the target, and the worst.
        """
        ranked = sorted(self.arms, key=lambda arm: -arm.test_rate)
        if self.baseline is None:
            reach, worst = sum(arm.test_rate >= self.target for arm in ranked), ranked[-1]
            least = f"the last, {worst.name}, solves {format_percent(worst.test_rate)}"
            return f"{reach} of {len(ranked)} solve {100 * self.target:g} % of their unseen starts; {least}."
        best, seeds, n = ranked[0], len(self.training_seeds), ranked[0].members[0].test.success.n
        over = f", the mean of {seeds} training seeds" if seeds > 1 else ""
        other = next((arm for arm in ranked[1:] if best.name == self.baseline or arm.name == self.baseline), None)
        behind = f"; {other.name} {format_percent(other.test_rate)}" if other else ""
        return f"{best.name} solves {format_percent(best.test_rate)} of {n:,} unseen starts{over}{behind}."

    @property
    def facts(self) -> list[str]:
        """Sentences after the verdict: comparisons with the baseline, how rounds were chosen, meaning of wall-clock."""
        return [
            *(comparison.verdict for comparison in self.comparisons.values()),
            *(seeds_facts(len(self.training_seeds)) if self.comparisons else []),
            self.rule.fact(self.limit),
            "Wall-clock is what collecting and fitting took; validating is not counted.",
        ]

    def tables(self) -> tuple[Table, ...]:
        """Return an arm a row: costs and success; costs to the target; success within given costs, if any."""
        return (self.results_table(), self.target_table(), *([self.within_table()] if self.within else []))

    def results_table(self) -> Table:
        """Return an arm a row, see `arms_table`; the expert's success first, the largest dip last."""
        tests = list(dict.fromkeys(test for found in self.experts.values() for test in found))
        table = arms_table(self.arms, self.comparisons)
        rows: list[tuple[str, ...]] = []
        for arm, (name, *cells) in zip(self.arms, table.rows, strict=True):
            found = self.experts.get(arm.name, {})
            experts = (format_percent(found[test].success.rate) if test in found else "" for test in tests)
            dip = 100 * max(largest_dip(member.history) for member in arm.members)
            rows.append((name, *experts, *cells, f"{dip:.1f}"))
        return Table((table.columns[0], *tests, *table.columns[1:], "largest dip [points]"), tuple(rows))

    def target_table(self) -> Table:
        """Return an arm a row: its mean costs when validation first reached the target in each training seed."""
        rows: list[tuple[str, ...]] = []
        for arm in self.arms:
            first = self.reached(arm)
            missed = f"not in {first.count(None)} of {len(first)} seeds"
            costs = (missed if None in first else _mean_cost(cost, first) for cost in _costs(self.arms))
            rows.append((arm.name, *costs))
        head = (f"{_head(cost)} to {100 * self.target:g} %" for cost in _costs(self.arms))
        return Table(("arm, validation", *head), tuple(rows))

    def within_table(self) -> Table:
        """Return an arm a row: the best validation success up to each of the costs `within`, empty before the first."""

        def best(arm: Arm, rule: Rule) -> str:
            rounds = [rule.within(member.history, rule.amount) for member in arm.members]
            return (
                _rates([max((one.validation for one in own), key=lambda one: one.rate) for own in rounds])
                if all(rounds)
                else ""
            )

        columns = [f"within {format_amount(one.axis, one.amount or 0)}" for one in self.within if one.axis != "end"]
        rows = [(arm.name, *(best(arm, rule) for rule in self.within)) for arm in self.arms]
        return Table(("arm, validation", *columns), tuple(rows))

    def reached(self, arm: Arm) -> list[Round | None]:
        """Return the round of each training seed in which validation first reached the target."""
        return [
            next((one for one in member.history if one.validation.rate >= self.target), None) for member in arm.members
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `study.json`."""
        return {
            "verdict": self.verdict,
            "facts": self.facts,
            "baseline": self.baseline,
            "target": self.target,
            "training_seeds": self.training_seeds,
            "arms": {arm.name: self._arm_json(arm) for arm in self.arms},
            "rule": self.rule.to_json(self.limit),
        }

    def _arm_json(self, arm: Arm) -> dict[str, Any]:
        comparison = self.comparisons.get(arm.name)
        return {
            "test_success": arm.test_rate,
            "validation_success": fmean(one.chosen.validation.rate for one in arm.members if one.chosen),
            "against_baseline": comparison.to_json() if comparison else None,
            "expert": {name: found.success.to_json() for name, found in self.experts.get(arm.name, {}).items()},
            "training_seeds": [
                {"seed": member.training_seed}
                | member.to_json()
                | {"largest_dip": largest_dip(member.history), "first_at_target": at.to_json() if at else None}
                | {"rounds": [one.to_json() for one in member.history]}
                for member, at in zip(arm.members, self.reached(arm), strict=True)
            ],
        }


def arms_table(arms: Sequence[Arm], comparisons: Mapping[str, Comparison]) -> Table:
    """Return an arm a row: mean costs and validation of its runs' rounds, test success, difference from the baseline.

    comparisons: arm -> its comparison with the baseline. In brackets each training seed, of one alone the interval.
    """
    costs, baseline = _costs(arms), next((one.left.name for one in comparisons.values()), "")
    rows: list[tuple[str, ...]] = []
    for arm in arms:
        chosen = [member.chosen for member in arm.members if member.chosen]
        known = [""] * (len(costs) + 1)
        if chosen:
            known = [*(_mean_cost(cost, chosen) for cost in costs), _rates([one.validation for one in chosen])]
        against = comparisons[arm.name].numbers if arm.name in comparisons else ""
        rows.append((arm.name, *known, _rates([member.test.success for member in arm.members]), against))
    return Table(("arm", *map(_head, costs), "validation", "test", f"test, against {baseline}"), tuple(rows))


def _head(cost: Cost) -> str:
    return "wall-clock" if cost == "seconds" else cost


def _mean_cost(cost: Cost, rounds: Sequence[Round | None]) -> str:
    """The mean amount without the unit that the column's head has."""
    return format_amount(cost, fmean(one.amount(cost) for one in rounds if one)).removesuffix(f" {cost}")


def _costs(arms: Sequence[Arm]) -> list[Cost]:
    """Costs in the tables; steps if they are not all labelled."""
    steps = any(has_unqueried_steps(member.history) for arm in arms for member in arm.members)
    return [cost for cost in COSTS if cost != "steps" or steps]


def _rates(found: Sequence[Proportion]) -> str:
    if len(found) == 1:
        return str(found[0])
    return f"{format_percent(fmean(one.rate for one in found))} ({', '.join(f'{100 * one.rate:.1f}' for one in found)})"
