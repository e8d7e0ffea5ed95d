"""Comparison of sides on the same test episodes: which one is better, and what each cost."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.evaluation.intervals import (
    CONFIDENCE,
    Proportion,
    format_p,
    format_percent,
    format_points,
    mean_interval,
    paired_interval,
    sign_flip_exact,
)
from manip_il.evaluation.report import Table
from manip_il.evaluation.results import require_comparable
from manip_il.evaluation.side import Cost, Round, Rule, Side, costs_of

FILE_NAME = "compare.json"


@dataclass(frozen=True)
class Comparison:
    """Two sides, paired by training seed and by test episode.

    Differences are right minus left.

    Attributes:
        left: The side that is compared with.
        right: The other side.

    Raises:
        MismatchError: if robot, task or settings differ.
        ManipError: unless all policies ran the same episodes.
    """

    left: Side
    right: Side

    def __post_init__(self) -> None:
        for one, other in zip(self.left.results, self.right.results, strict=True):
            require_comparable(self.left.name, one, self.right.name, other)
        results = self.left.results + self.right.results
        if len({frozenset(one.seed for one in result.episodes) for result in results}) > 1:
            raise ManipError(
                f"test episodes of {self.left.name} and {self.right.name} differ; evaluate both"
                " with the same --seed and --eval.n_episodes"
            )

    @cached_property
    def _solved(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """1 where left or right solved an episode, else 0, (training seeds, episodes) each."""
        return _outcomes(self.left), _outcomes(self.right)

    @cached_property
    def differences(self) -> NDArray[np.int64]:
        """Right's success minus left's, (training seeds, test episodes)."""
        left, right = self._solved
        return right - left

    @property
    def means(self) -> list[float]:
        """Difference in success rate for each training seed, in [-1, 1]."""
        return self.differences.mean(axis=1).tolist()

    @property
    def difference(self) -> float:
        """Difference in success rate, averaged over training seeds, in [-1, 1]."""
        return fmean(self.means)

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high) of `difference`: Bonett and Price's interval for one training seed,
        Student's for two or more.
        """
        if len(self.means) == 1:
            return paired_interval(self.differences[0].tolist())
        return mean_interval(self.means)

    @cached_property
    def p_value(self) -> float:
        """Exact two-sided p of `sign_flip_exact` over test episodes.

        For one training seed, of McNemar's test.

        It holds for these trained policies; `interval` also covers other training seeds.
        """
        return sign_flip_exact(self.differences.sum(axis=0).tolist())

    @property
    def significant(self) -> bool:
        """Whether one side is better by the exact test and, with several training seeds, also by
        the t interval.
        """
        low, high = self.interval
        return self.p_value < 1 - CONFIDENCE and (len(self.means) == 1 or low > 0 or high < 0)

    @property
    def verdict(self) -> str:
        """A sentence: which side is better, or that neither is shown to be better, with
        difference, interval and p.
        """
        n, sign = len(self.means), -1 if self.difference < 0 else 1
        leads = sum(sign * mean > 0 for mean in self.means)
        tested = f"{format_p(self.p_value)}, {self.differences.shape[1]:,} paired episodes"
        tested += f" on each of {n} training seeds, ahead in {leads}" if n > 1 else ""
        if not self.significant:
            points = format_points(self.difference, self.interval)
            return (
                f"No difference shown between {self.right.name} and {self.left.name}: {points},"
                f" {tested}."
            )
        better, worse = (self.left, self.right) if sign < 0 else (self.right, self.left)
        low, high = sorted(100 * sign * end for end in self.interval)
        points = f"{100 * abs(self.difference):.1f} points [{low:.1f}, {high:.1f}]"
        return f"{better.name} is better than {worse.name} by {points}, {tested}."

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; differences are right minus left."""
        left, right = self._solved
        kinds = ("neither", "only_right", "only_left", "both")
        counts = np.bincount((2 * left + right).ravel(), minlength=len(kinds))
        return {
            "left": self.left.name,
            "right": self.right.name,
            "difference": self.difference,
            "interval": list(self.interval),
            "confidence": CONFIDENCE,
            "p_value": self.p_value,
            "n_episodes": self.differences.shape[1],
            "verdict": self.verdict,
            **dict(zip(kinds, counts.tolist(), strict=True)),
            "differences": self.means,
        }


@dataclass(frozen=True)
class Study:
    """Tested sides with the same training seeds, and what they cost.

    Attributes:
        sides: The sides.
        baseline: Name of the side that the others are compared with; None for sides of different
            tasks.
        rule: How each run's round was chosen.
        target: Validation success for which the cost is reported, in [0, 1].

    Raises:
        MismatchError: if robot, task or settings of two compared sides differ.
        ManipError: unless all sides of a comparison ran the same episodes.
    """

    sides: tuple[Side, ...]
    baseline: str | None
    rule: Rule = field(default_factory=Rule)
    target: float = 0.95

    def __post_init__(self) -> None:
        _ = self.comparisons  # which raise

    @cached_property
    def comparisons(self) -> dict[str, Comparison]:
        """Side -> its comparison with the baseline, for every other side.

        Empty without a baseline.
        """
        if self.baseline is None:
            return {}
        baseline = next(side for side in self.sides if side.name == self.baseline)
        return {
            side.name: Comparison(baseline, side) for side in self.sides if side is not baseline
        }

    @property
    def verdict(self) -> str:
        """The first sentence: the better of two sides, or how well each of several does, the
        best one first.
        """
        if len(self.comparisons) == 1:
            return next(iter(self.comparisons.values())).verdict
        best, *others = sorted(self.sides, key=lambda side: -side.rate)
        n, seeds = best.results[0].success.n, len(best.members)
        over = f", the mean of {seeds} training seeds" if seeds > 1 else ""
        rates = ", ".join(f"{side.name} {format_percent(side.rate)}" for side in others)
        return (
            f"{best.name} solves {format_percent(best.rate)} of {n:,} unseen starts{over}; {rates}."
        )

    @property
    def facts(self) -> list[str]:
        """Return the sentences after the verdict: comparisons with the baseline, and how rounds
        were chosen.
        """
        verdicts = [comparison.verdict for comparison in self.comparisons.values()]
        facts = verdicts if len(verdicts) > 1 else []
        if self.comparisons and len(self.sides[0].members) > 1:
            facts.append(
                "Intervals are Student's over training seeds; p is exact and holds for these"
                " policies alone."
            )
        if any(member.chosen for side in self.sides for member in side.members):
            facts.append(self.rule.fact)
        return facts

    def table(self) -> Table:
        """Return one row per side, and one for each of several tasks: mean costs, validation, test
        success, difference, cost to the target on validation.

        Brackets hold the values of each training seed or, for a single seed, the interval.
        """
        rows: list[tuple[str, ...]] = []
        costs = costs_of(member.history for side in self.sides for member in side.members)
        for side in self.sides:
            against = self.comparisons.get(side.name)
            chosen = [member.chosen for member in side.members if member.chosen]
            cells = [_mean_cost(cost, chosen) if chosen else "" for cost in costs]
            cells.append(_rates([one.validation for one in chosen]) if chosen else "")
            cells.append(_rates([result.success for result in side.results]))
            points = ""
            if against:
                difference = format_points(against.difference, against.interval)
                points = f"{difference}, {format_p(against.p_value)}"
            reached = "not reached" if side.histories else ""
            if None not in (first := self._reached(side)):
                reached = _mean_cost(costs[0], first)
            rows.append((side.name, *cells, points, reached))
            blank = [""] * (len(cells) - 1)
            for task, found in side.by_task.items():
                rows.append((f"{side.name}: {task}", *blank, _rates(found), "", ""))
        head = ("side", *costs, "validation", "test", f"test, against {self.baseline}")
        return Table((*head, f"{costs[0]} to {100 * self.target:g} %"), tuple(rows))

    def _reached(self, side: Side) -> list[Round | None]:
        """Return, for each training seed, the round in which validation first reached the
        target.
        """
        return [
            next((one for one in member.history if one.validation.rate >= self.target), None)
            for member in side.members
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `compare.json`."""
        result = self.sides[0].results[0]
        seeds = [episode.seed for episode in result.episodes]
        return {
            "verdict": self.verdict,
            "facts": self.facts,
            "baseline": self.baseline,
            "target": self.target,
            "rule": {
                "checkpoint": self.rule.checkpoint,
                "at": self.rule.at,
                "limit": self.rule.limit,
            },
            "arms": {side.name: self._side_json(side) for side in self.sides},
            "robot": result.robot,
            "test_seeds": [min(seeds), max(seeds)],
        }

    def _side_json(self, side: Side) -> dict[str, Any]:
        against, test = self.comparisons.get(side.name), side.results[0]
        return {
            "task": test.task,
            "settings": test.settings.to_json(),
            "test_success": side.rate,
            "by_task": {
                task: fmean(one.rate for one in found) for task, found in side.by_task.items()
            },
            "against_baseline": against.to_json() if against else None,
            "training_seeds": [
                member.to_json() | {"first_at_target": first.to_json() if first else None}
                for member, first in zip(side.members, self._reached(side), strict=True)
            ],
        }


def _outcomes(side: Side) -> NDArray[np.int64]:
    """Return 1 where a policy solved an episode, else 0, (training seeds, episodes by seed)."""
    solved = (sorted((one.seed, one.success) for one in found.episodes) for found in side.results)
    return np.array([[success for _, success in one] for one in solved], np.int64)


def _mean_cost(cost: Cost, rounds: Sequence[Round | None]) -> str:
    """Return the mean amount without its unit, which is in the column's header."""
    return f"{fmean(one.amount(cost) for one in rounds if one):,.0f}"


def _rates(found: Sequence[Proportion]) -> str:
    if len(found) == 1:
        return str(found[0])
    return (
        f"{format_percent(fmean(one.rate for one in found))}"
        f" ({', '.join(f'{100 * one.rate:.1f}' for one in found)})"
    )
