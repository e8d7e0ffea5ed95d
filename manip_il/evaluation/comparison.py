"""Comparison of arms on the same test episodes: which one is better, and what each cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import fmean
from typing import Any

from manip_il.errors import ManipError
from manip_il.evaluation.arm import Arm
from manip_il.evaluation.intervals import (
    CONFIDENCE,
    PairCounts,
    Proportion,
    format_p,
    format_percent,
    format_points,
    mean_interval,
    sign_flip_exact,
)
from manip_il.evaluation.results import EvalResult, require_comparable
from manip_il.evaluation.rounds import COSTS, Cost, Round, Rule, format_amount, has_unlabelled_steps
from manip_il.evaluation.tables import Table

FILE_NAME = "compare.json"
TARGET = 0.95


@dataclass(frozen=True)
class Comparison:
    """`right` against `left`, paired by training seed and by test episode. Differences are right minus left.

    results: (left, right) for each training seed; episodes that only one side ran do not count. Raises
    `MismatchError` if robot, task or settings differ, `ManipError` if left and right share no episode.
    """

    left: str
    right: str
    results: tuple[tuple[EvalResult, EvalResult], ...]

    def __post_init__(self) -> None:
        for left, right in self.results:
            require_comparable(self.left, left, self.right, right)
        if not all(self._outcomes):
            raise ManipError(f"{self.left} and {self.right} share no seed; evaluate both with the same --seed=")

    @classmethod
    def of(cls, left: Arm, right: Arm) -> Comparison:
        """Compare two arms. Raises what `Comparison` does; `ManipError` unless all policies ran the same episodes."""
        members = (*left.members, *right.members)
        if len({frozenset(episode.seed for episode in one.test.episodes) for one in members}) > 1:
            raise ManipError(
                f"test episodes of {left.name} and {right.name} differ; evaluate both with the same --seed and "
                "--eval.n_episodes"
            )
        pairs = zip(left.members, right.members, strict=True)
        return cls(left.name, right.name, tuple((one.test, other.test) for one, other in pairs))

    @cached_property
    def _outcomes(self) -> list[dict[int, tuple[bool, bool]]]:
        """Outcomes (left, right) by test episode, for each training seed."""
        found: list[dict[int, tuple[bool, bool]]] = []
        for left, right in self.results:
            theirs = {episode.seed: episode.success for episode in right.episodes}
            ours = (one for one in left.episodes if one.seed in theirs)
            found.append({one.seed: (one.success, theirs[one.seed]) for one in ours})
        return found

    @cached_property
    def pairs(self) -> tuple[PairCounts, ...]:
        """The paired outcomes of each training seed."""
        return tuple(PairCounts.of(outcomes.values()) for outcomes in self._outcomes)

    @property
    def difference(self) -> float:
        """Difference in success rate, averaged over training seeds, in [-1, 1]."""
        return fmean(pair.difference for pair in self.pairs)

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high) of `difference`: Newcombe's interval for one training seed, Student's for two or more."""
        if len(self.pairs) == 1:
            return self.pairs[0].interval
        return mean_interval([pair.difference for pair in self.pairs])

    @cached_property
    def p_value(self) -> float:
        """Exact two-sided p of `sign_flip_exact` over test episodes; for one training seed, of McNemar's test.

        It holds for these trained policies; `interval` also covers other training seeds.
        """
        margins: Counter[int] = Counter()
        for seed, (left, right) in (one for outcomes in self._outcomes for one in outcomes.items()):
            margins[seed] += right - left
        return sign_flip_exact(list(margins.values()))

    @property
    def significant(self) -> bool:
        """Whether one arm is better by the exact test and, with several training seeds, also by the t interval."""
        low, high = self.interval
        return self.p_value < 1 - CONFIDENCE and (len(self.pairs) == 1 or low > 0 or high < 0)

    @property
    def verdict(self) -> str:
        """A sentence: which arm is better, or that neither is shown to be better, with difference, interval and p."""
        n, sign = len(self.pairs), -1 if self.difference < 0 else 1
        leads = sum(sign * pair.difference > 0 for pair in self.pairs)
        tested = f"{format_p(self.p_value)}, {self.pairs[0].n:,} paired episodes"
        tested += f" on each of {n} training seeds, ahead in {leads}" if n > 1 else ""
        if not self.significant:
            points = format_points(self.difference, self.interval)
            return f"No difference shown between {self.right} and {self.left}: {points}, {tested}."
        better, worse = (self.left, self.right) if sign < 0 else (self.right, self.left)
        low, high = sorted(100 * sign * end for end in self.interval)
        points = f"{100 * abs(self.difference):.1f} points [{low:.1f}, {high:.1f}]"
        return f"{better} is better than {worse} by {points}, {tested}."

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; differences are right minus left."""
        counts = ("both", "only_left", "only_right", "neither")
        return {
            "left": self.left,
            "right": self.right,
            "difference": self.difference,
            "interval": list(self.interval),
            "confidence": CONFIDENCE,
            "p_value": self.p_value,
            "n_episodes": self.pairs[0].n,
            "verdict": self.verdict,
            **{name: sum(getattr(pair, name) for pair in self.pairs) for name in counts},
            "differences": [pair.difference for pair in self.pairs],
        }


@dataclass(frozen=True)
class Study:
    """Tested arms with the same training seeds, and what they cost.

    baseline: the arm that the others are compared with; None for arms of different tasks. rule: how each run's round
    was chosen. target: validation success for which the cost is reported.
    """

    arms: tuple[Arm, ...]
    baseline: str | None
    rule: Rule = field(default_factory=Rule)
    target: float = TARGET

    @cached_property
    def comparisons(self) -> dict[str, Comparison]:
        """Arm -> its comparison with the baseline, for every other arm; empty without a baseline."""
        if self.baseline is None:
            return {}
        baseline = next(arm for arm in self.arms if arm.name == self.baseline)
        return {arm.name: Comparison.of(baseline, arm) for arm in self.arms if arm is not baseline}

    @property
    def verdict(self) -> str:
        """The first sentence: the better of two arms, the best of several, or how many tasks reach the target."""
        if len(self.comparisons) == 1:
            return next(iter(self.comparisons.values())).verdict
        ranked = sorted(self.arms, key=lambda arm: -arm.test_rate)
        best, last, seeds = ranked[0], ranked[-1], len(self.arms[0].members)
        if self.baseline is None:
            reach = sum(arm.test_rate >= self.target for arm in ranked)
            least = f"the last, {last.name}, solves {format_percent(last.test_rate)}"
            return f"{reach} of {len(ranked)} solve {100 * self.target:g} % of their unseen starts; {least}."
        over = f", the mean of {seeds} training seeds" if seeds > 1 else ""
        rates = ", ".join(f"{arm.name} {format_percent(arm.test_rate)}" for arm in ranked[1:])
        n = best.members[0].test.success.n
        return f"{best.name} solves {format_percent(best.test_rate)} of {n:,} unseen starts{over}; {rates}."

    @property
    def facts(self) -> list[str]:
        """Return the sentences after the verdict: comparisons with the baseline, and how rounds were chosen."""
        verdicts = [comparison.verdict for comparison in self.comparisons.values()]
        facts = verdicts if len(verdicts) > 1 else []
        if self.comparisons and (seeds := len(self.arms[0].members)) > 1:
            facts.append(
                f"Intervals are Student's over {seeds} training seeds; p is exact over test episodes and holds for "
                "these policies alone."
            )
        if any(member.chosen for arm in self.arms for member in arm.members):
            facts.append(self.rule.fact)
        return facts

    @property
    def tables(self) -> tuple[Table, ...]:
        """The results, and the costs to reach the target if all arms are runs."""
        runs = all(arm.has_histories for arm in self.arms)
        return (self.results_table(), self.target_table()) if runs else (self.results_table(),)

    def results_table(self) -> Table:
        """Return one row per arm: mean costs, validation, test success, difference.

        Brackets hold the values of each training seed or, for a single seed, the interval.
        """
        rows: list[tuple[str, ...]] = []
        for arm in self.arms:
            against, chosen = self.comparisons.get(arm.name), [one.chosen for one in arm.members if one.chosen]
            cells = [_mean_cost(cost, chosen) if chosen else "" for cost in self._costs]
            cells.append(_rates([one.validation for one in chosen]) if chosen else "")
            cells.append(_rates([one.test.success for one in arm.members]))
            points = against and f"{format_points(against.difference, against.interval)}, {format_p(against.p_value)}"
            rows.append((arm.name, *cells, points or ""))
        head = ("arm", *map(_head, self._costs), "validation", "test", f"test, against {self.baseline}")
        return Table(head, tuple(rows))

    def target_table(self) -> Table:
        """Return one row per arm: its mean costs when validation first reached the target in each training seed."""
        rows: list[tuple[str, ...]] = []
        for arm in self.arms:
            first = self._reached(arm)
            missed = f"not reached in {first.count(None)} of {len(first)} seeds"
            rows.append((arm.name, *(missed if None in first else _mean_cost(cost, first) for cost in self._costs)))
        head = (f"{_head(cost)} to {100 * self.target:g} %" for cost in self._costs)
        return Table(("arm, validation", *head), tuple(rows))

    @property
    def _costs(self) -> list[Cost]:
        """The costs shown in tables; steps only if some have no label."""
        steps = any(has_unlabelled_steps(member.history) for arm in self.arms for member in arm.members)
        return [cost for cost in COSTS if cost != "steps" or steps]

    def _reached(self, arm: Arm) -> list[Round | None]:
        """Return, for each training seed, the round in which validation first reached the target."""
        return [
            next((one for one in member.history if one.validation.rate >= self.target), None) for member in arm.members
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `compare.json`."""
        result = self.arms[0].members[0].test
        seeds = [episode.seed for episode in result.episodes]
        return {
            "verdict": self.verdict,
            "facts": self.facts,
            "baseline": self.baseline,
            "target": self.target,
            "rule": {"checkpoint": self.rule.checkpoint, "at": self.rule.at, "limit": self.rule.limit},
            "arms": {arm.name: self._arm_json(arm) for arm in self.arms},
            "robot": result.robot,
            "test_seeds": [min(seeds), max(seeds)],
        }

    def _arm_json(self, arm: Arm) -> dict[str, Any]:
        against, test = self.comparisons.get(arm.name), arm.members[0].test
        return {
            "task": test.task,
            "settings": test.settings.to_json(),
            "test_success": arm.test_rate,
            "against_baseline": against.to_json() if against else None,
            "training_seeds": [
                member.to_json() | {"first_at_target": first.to_json() if first else None}
                for member, first in zip(arm.members, self._reached(arm), strict=True)
            ],
        }


def _head(cost: Cost) -> str:
    return "wall-clock" if cost == "seconds" else cost


def _mean_cost(cost: Cost, rounds: Sequence[Round | None]) -> str:
    """Return the mean amount without its unit, which is in the column's header."""
    return format_amount(cost, fmean(one.amount(cost) for one in rounds if one)).removesuffix(f" {cost}")


def _rates(found: Sequence[Proportion]) -> str:
    if len(found) == 1:
        return str(found[0])
    return f"{format_percent(fmean(one.rate for one in found))} ({', '.join(f'{100 * one.rate:.1f}' for one in found)})"
