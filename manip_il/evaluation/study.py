"""A study: several arms with the same training seeds, compared with a baseline, and their costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import fmean
from typing import Any

from manip_il.errors import ManipError, UnknownName
from manip_il.evaluation.comparison import Arm, Comparison, Member, seeds_facts
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report_data import COSTS, Cost, format_amount
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.rounds import Round, Rule, first_reaching, largest_dip, rounds_within, rule_facts, unasked
from manip_il.evaluation.tables import Table

FILE_NAME, TABLE_FILE = "study.json", "table.md"


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

    def __post_init__(self) -> None:
        names = [arm.name for arm in self.arms]
        if self.baseline is not None and self.baseline not in names:
            raise UnknownName("baseline", self.baseline, names)
        for arm in self.arms:
            if not all(member.history and member.chosen for member in arm.members):
                raise ManipError(f"arm {arm.name!r} holds a policy that belongs to no run")

    @property
    def training_seeds(self) -> list[int | None]:
        """Training seeds, the same in every arm."""
        return self.arms[0].training_seeds

    @cached_property
    def comparisons(self) -> dict[str, Comparison]:
        """Arm -> its comparison with the baseline, for every other arm; empty where there is no baseline."""
        if self.baseline is None:
            return {}
        [baseline] = [arm for arm in self.arms if arm.name == self.baseline]
        return {arm.name: Comparison(baseline, arm) for arm in self.arms if arm is not baseline}

    @property
    def verdict(self) -> str:
        """The first sentence: success of the best arm, and of the baseline, or of the second where that is best.

        Of arms without a baseline: how many reach the target, and the worst.
        """
        ranked = sorted(self.arms, key=lambda arm: -arm.test_rate)
        if self.baseline is None:
            reach, worst = sum(arm.test_rate >= self.target for arm in ranked), ranked[-1]
            least = f"the last, {worst.name}, solves {format_percent(worst.test_rate)}"
            return f"{reach} of {len(ranked)} solve {100 * self.target:g} % of their unseen starts; {least}."
        best, count, seeds = ranked[0], ranked[0].members[0].result.success.n, len(self.training_seeds)
        over = f", the mean of {seeds} training seeds" if seeds > 1 else ""
        other = next((arm for arm in ranked[1:] if best.name == self.baseline or arm.name == self.baseline), None)
        behind = f"; {other.name} {format_percent(other.test_rate)}" if other else ""
        return f"{best.name} solves {format_percent(best.test_rate)} of {count:,} unseen starts{over}{behind}."

    @property
    def facts(self) -> list[str]:
        """Sentences after the verdict: comparisons with the baseline, how rounds were chosen, meaning of wall-clock."""
        chosen = [_chosen(member) for arm in self.arms for member in arm.members]
        return [
            *(comparison.verdict for comparison in self.comparisons.values()),
            *(seeds_facts(len(self.training_seeds)) if self.comparisons else []),
            *rule_facts(self.rule, self.limit, chosen),
            "Wall-clock is what collecting and fitting took; validating is not counted.",
        ]

    def reached(self, arm: Arm) -> list[Round | None]:
        """Return the round of each training seed in which validation first reached the target."""
        return [first_reaching(member.history, self.target) for member in arm.members]

    def results_table(self) -> Table:
        """Return an arm a row: the expert's success, costs, success, difference from the baseline, largest dip."""
        columns = ("arm", *self._tests, *("wall-clock" if cost == "seconds" else cost for cost in self._costs))
        columns += ("validation", "test", f"test, against {self.baseline}")
        return Table((*columns, "largest dip [points]"), tuple(self._row(arm) for arm in self.arms))

    def target_table(self) -> Table:
        """Return an arm a row: labels, episodes, steps and wall-clock when validation first reached the target."""
        columns = [f"{'wall-clock' if cost == 'seconds' else cost} to {100 * self.target:g} %" for cost in self._costs]
        rows = [
            (arm.name, *(self._to_target(arm, cost) for cost in self._costs), self._fewer(arm)) for arm in self.arms
        ]
        return Table(("arm, validation", *columns, f"labels of {self.baseline} / of this arm"), tuple(rows))

    def within_table(self) -> Table:
        """Return an arm a row: the best validation success up to each of the costs `within`, empty before the first."""
        columns = [f"within {rule.words}" for rule in self.within]
        rows = [(arm.name, *(_within(arm, rule) for rule in self.within)) for arm in self.arms]
        return Table(("arm, validation", *columns), tuple(rows))

    def to_json(self) -> dict[str, Any]:
        """Return the contract of `study.json`."""
        return {
            "verdict": self.verdict,
            "facts": self.facts,
            "baseline": self.baseline,
            "target": self.target,
            "training_seeds": self.training_seeds,
            "arms": {arm.name: self._arm_json(arm) for arm in self.arms},
        }

    def _arm_json(self, arm: Arm) -> dict[str, Any]:
        comparison = self.comparisons.get(arm.name)
        return {
            "test_success": arm.test_rate,
            "validation_success": fmean(_chosen(member).validation.rate for member in arm.members),
            "against_baseline": comparison.to_json() if comparison else None,
            "expert": {name: _expert_json(result) for name, result in self.experts.get(arm.name, {}).items()},
            "training_seeds": [
                {"seed": member.training_seed}
                | member.to_json()
                | {"largest_dip": largest_dip(member.history), "first_at_target": at.to_json() if at else None}
                | {"rounds": [one.to_json() for one in member.history]}
                for member, at in zip(arm.members, self.reached(arm), strict=True)
            ],
        }

    @property
    def _costs(self) -> list[Cost]:
        """Costs in the tables."""
        steps = any(unasked(member.history) for arm in self.arms for member in arm.members)
        return [cost for cost in COSTS if cost != "steps" or steps]

    @property
    def _tests(self) -> list[str]:
        """Names of the expert's tests, in the order of the first arm that has them."""
        return list(dict.fromkeys(test for tests in self.experts.values() for test in tests))

    def _expert(self, arm: str, test: str) -> str:
        result = self.experts.get(arm, {}).get(test)
        return "" if result is None else format_percent(result.success.rate)

    def _row(self, arm: Arm) -> tuple[str, ...]:
        chosen = [_chosen(member) for member in arm.members]
        costs = [_plain(cost, fmean(one.amount(cost) for one in chosen)) for cost in self._costs]
        validation = _rates([one.validation.rate for one in chosen])
        test = _rates([member.result.success.rate for member in arm.members])
        comparison = self.comparisons.get(arm.name)
        dip = max(largest_dip(member.history) for member in arm.members)
        experts = [self._expert(arm.name, test) for test in self._tests]
        return (
            arm.name,
            *experts,
            *costs,
            validation,
            test,
            comparison.numbers if comparison else "",
            f"{100 * dip:.1f}",
        )

    def _to_target(self, arm: Arm, cost: Cost) -> str:
        """Mean cost where all training seeds reached the target, else each: its cost, or more than its whole cost."""
        reached = self.reached(arm)
        if all(reached):
            return _plain(cost, fmean(one.amount(cost) for one in reached if one))
        each = zip(arm.members, reached, strict=True)
        return ", ".join(("" if at else "> ") + _plain(cost, (at or m.history[-1]).amount(cost)) for m, at in each)

    def _fewer(self, arm: Arm) -> str:
        """Labels of the baseline over this arm's, to the target; a lower bound where the baseline missed it."""
        if self.baseline in (None, arm.name):
            return ""
        ours = [one.labels for one in self.reached(arm) if one]
        if len(ours) < len(arm.members):
            return "not reached"
        baseline = self.comparisons[arm.name].left
        reached = self.reached(baseline)
        theirs = [(at or member.history[-1]).labels for member, at in zip(baseline.members, reached, strict=True)]
        return f"{'' if all(reached) else '> '}{sum(theirs) / sum(ours):.1f}"


def table_markdown(study: Study) -> str:
    """Return both tables, for the documentation."""
    tables = [study.results_table(), study.target_table(), *([study.within_table()] if study.within else [])]
    count = study.arms[0].members[0].result.success.n
    tests = {test: len(one.episodes) for tests in study.experts.values() for test, one in tests.items()}
    experts = "".join(f"- {test}: {count:,} test episodes.\n" for test, count in tests.items())
    seeds = ", ".join(map(str, study.training_seeds))
    episodes = f"{count:,} test episodes; training seeds {seeds}, in brackets where each is told."
    facts = "".join(f"- {fact}\n" for fact in [episodes, *study.facts])
    return "".join(f"{table.filled().markdown()}\n" for table in tables) + facts + experts


def _expert_json(result: EvalResult) -> dict[str, Any]:
    success = result.success
    return {"success_rate": success.rate, "interval": list(success.interval), "n_episodes": success.n}


def _within(arm: Arm, rule: Rule) -> str:
    """The best validation success of every training seed up to a cost."""
    rounds = [rounds_within(rule, member.history, rule.amount) for member in arm.members]
    return _rates([max(one.validation.rate for one in own) for own in rounds]) if all(rounds) else ""


def _chosen(member: Member) -> Round:
    assert member.chosen is not None
    return member.chosen


def _plain(cost: Cost, amount: float) -> str:
    """The amount without the unit that the column's head has."""
    return format_amount(cost, amount).removesuffix(f" {cost}")


def _rates(rates: Sequence[float]) -> str:
    each = f" ({', '.join(f'{100 * rate:.1f}' for rate in rates)})" if len(rates) > 1 else ""
    return f"{format_percent(fmean(rates))}{each}"
