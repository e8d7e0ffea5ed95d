"""Two arms of one or several training seeds on the same test episodes: which one is better."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any

from manip_il.errors import ManipError
from manip_il.evaluation.arm import Arm, require_pair
from manip_il.evaluation.intervals import (
    CONFIDENCE,
    PairedComparison,
    format_p,
    format_points,
    mean_interval,
    sign_flip_exact,
)
from manip_il.evaluation.results import EvalResult, compare_results

FILE_NAME = "compare.json"
_OF_PAIR = ("both", "only_left", "only_right", "neither", "difference", "interval", "p_value")


@dataclass(frozen=True)
class Comparison:
    """`right` against `left`, paired by training seed and by test episode. Differences are right minus left.

    Raises `UsageError` if training seeds do not match, `MismatchError` if robot, task or settings differ, and
    `ManipError` if the test episodes are not the same.
    """

    left: Arm
    right: Arm

    def __post_init__(self) -> None:
        require_pair(self.left, self.right)
        # Also policies of different training seeds must have run the same episodes.
        first, *others = (*self.left.members, *self.right.members)
        for other in others:
            require_same_episodes(first.name, first.test, other.name, other.test)
        _ = self.pairs

    @property
    def arms(self) -> tuple[Arm, Arm]:
        """Left and right."""
        return self.left, self.right

    @cached_property
    def pairs(self) -> tuple[PairedComparison, ...]:
        """The paired comparison of each training seed."""
        members = zip(self.left.members, self.right.members, strict=True)
        return tuple(compare_results(a.test, b.test, (self.left.name, self.right.name)) for a, b in members)

    @property
    def difference(self) -> float:
        """Mean difference over training seeds, in [-1, 1]."""
        return fmean(pair.difference for pair in self.pairs)

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high) of `difference`: Newcombe's for one training seed, Student's over training seeds for more."""
        if len(self.pairs) == 1:
            return self.pairs[0].interval
        return mean_interval([pair.difference for pair in self.pairs])

    @cached_property
    def p_value(self) -> float:
        """Two-sided and exact over test episodes, all training seeds together; with one it is McNemar's.

        It holds for these trained policies; `interval` is about other training seeds, too.
        """
        margins: Counter[int] = Counter()
        for arm, sign in ((self.left, -1), (self.right, 1)):
            for episode in (one for member in arm.members for one in member.test.episodes):
                margins[episode.seed] += sign * episode.success
        return sign_flip_exact(list(margins.values()))

    @property
    def significant(self) -> bool:
        """Whether one arm is better by the exact test, and with several seeds by the t interval, too."""
        low, high = self.interval
        return self.p_value < 1 - CONFIDENCE and (len(self.pairs) == 1 or low > 0 or high < 0)

    @property
    def verdict(self) -> str:
        """One sentence with the difference, its interval and p."""
        n, left, right = len(self.pairs), self.left.name, self.right.name
        sign = -1 if self.difference < 0 else 1
        better, worse = (left, right) if sign < 0 else (right, left)
        each = f" on each of {n} training seeds" if n > 1 else ""
        tested = f"{format_p(self.p_value)}, {self.pairs[0].n:,} paired episodes{each}"
        over = f" on average over {n} training seeds" if n > 1 else ""
        leads = sum(sign * pair.difference > 0 for pair in self.pairs)
        ahead = f"{over} (ahead in {leads} of {n})" if over else ""
        low, high = sorted(100 * sign * end for end in self.interval)
        points = f"{100 * sign * self.difference:z.1f} points [{low:z.1f}, {high:z.1f}]"  # z: no minus before a 0.0
        if self.significant:
            return f"{better} is better than {worse} by {points}{ahead}, {tested}."
        if self.p_value < 1 - CONFIDENCE:
            return (
                f"These policies of {better} are better than those of {worse} ({tested}), but {n} training seeds do "
                f"not show that others would be: {points}{ahead}."
            )
        points = format_points(self.difference, self.interval)
        return (
            f"No difference shown between {right} and {left}: {points}{ahead if self.difference else over}, {tested}."
        )

    @property
    def numbers(self) -> str:
        """`+4.2 points [+1.1, +7.3], p = 0.002`: right minus left."""
        return f"{format_points(self.difference, self.interval)}, {format_p(self.p_value)}"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; differences are right minus left."""
        several = len(self.pairs) > 1
        return {
            "left": self.left.name,
            "right": self.right.name,
            "difference": self.difference,
            "interval": list(self.interval),
            "interval_method": "Student's t over training seeds" if several else "Newcombe's for paired proportions",
            "confidence": CONFIDENCE,
            "p_value": self.p_value,
            "only_left": sum(pair.only_left for pair in self.pairs),
            "only_right": sum(pair.only_right for pair in self.pairs),
            "n_episodes": self.pairs[0].n,
            "verdict": self.verdict,
            "training_seeds": [
                {"left_seed": left.training_seed, "right_seed": right.training_seed}
                | {"left": left.to_json(), "right": right.to_json()}
                | {key: getattr(pair, key) for key in _OF_PAIR}
                for left, right, pair in zip(self.left.members, self.right.members, self.pairs, strict=True)
            ],
        }

    def file_json(self) -> dict[str, Any]:
        """Return the contents of `compare.json`: `to_json`, and on which episodes both were tested."""
        result = self.left.members[0].test
        seeds = [episode.seed for episode in result.episodes]
        settings = {"robot": result.robot, "task": result.task, "settings": result.settings.to_json()}
        return self.to_json() | settings | {"test_seeds": [min(seeds), max(seeds)]}


def require_same_episodes(left_name: str, left: EvalResult, right_name: str, right: EvalResult) -> None:
    """Raise `ManipError` with both numbers unless both ran exactly the same seeds."""
    ours, theirs = ({episode.seed for episode in one.episodes} for one in (left, right))
    if ours != theirs:
        raise ManipError(
            f"test episodes differ: {left_name} has {len(ours)}, {right_name} {len(theirs)}, of which "
            f"{len(ours & theirs)} are the same; evaluate both with the same --seed and --eval.n_episodes"
        )


def seeds_facts(count: int) -> list[str]:
    """Return a sentence on the interval and the test over `count` training seeds; none for a single one."""
    if count == 1:
        return []
    return [
        f"The interval is Student's over {count} training seeds; with so few it is wide. "
        "p is exact over test episodes, which flip together for all training seeds, and holds for these policies alone."
    ]
