"""Two arms of one or several training seeds on the same test episodes: which one is better."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.intervals import mean_interval
from manip_il.evaluation.results import EvalResult, compare_results
from manip_il.evaluation.rounds import History, Round, Rule, rule_facts
from manip_il.evaluation.significance import PairedComparison, format_p, sign_flip_exact

FILE_NAME = "compare.json"
_OF_PAIR = ("both", "only_left", "only_right", "neither", "difference", "interval", "p_value")


@dataclass(frozen=True)
class Member:
    """One policy of an arm, with its test.

    training_seed: None where not known. file: the evaluation's. policy: its folder, None where there is only an
    evaluation. chosen, history: the round that it is and all rounds of its run, where it is of a run.
    """

    name: str
    result: EvalResult
    file: Path
    training_seed: int | None = None
    policy: Path | None = None
    chosen: Round | None = None
    history: History = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "name": self.name,
            "policy": None if self.policy is None else str(self.policy),
            "chosen": None if self.chosen is None else self.chosen.to_json(),
            "success_rate": self.result.success.rate,
            "interval": list(self.result.success.interval),
            "n_episodes": self.result.success.n,
            "evaluation": str(self.file),
        }


@dataclass(frozen=True)
class Arm:
    """One side of a comparison: one policy, or one a training seed."""

    name: str
    members: tuple[Member, ...]

    def __post_init__(self) -> None:
        seeds = self.training_seeds
        if not seeds or len(set(seeds)) != len(seeds):
            raise ManipError(f"{self.name} has training seeds {seeds}; expected each once, and at least one")

    @property
    def training_seeds(self) -> list[int | None]:
        """Training seeds, in the order of the members."""
        return [member.training_seed for member in self.members]

    @property
    def test_rate(self) -> float:
        """Mean success over training seeds."""
        return fmean(member.result.success.rate for member in self.members)


@dataclass(frozen=True)
class Comparison:
    """`right` against `left`, paired by training seed and by test episode. Differences are right minus left.

    Raises `UsageError` where training seeds do not match, `MismatchError` where robot, task or settings differ, and
    `ManipError` where the test episodes are not the same.
    """

    left: Arm
    right: Arm

    def __post_init__(self) -> None:
        if self.left.name == self.right.name:
            raise UsageError(f"{self.left.name} is compared with itself; give two different ones")
        if len(self.left.members) != len(self.right.members) or (
            len(self.left.members) > 1 and self.left.training_seeds != self.right.training_seeds
        ):
            raise UsageError(
                f"training seeds differ: {self.left.name} has {_listed(self.left)}, {self.right.name} "
                f"{_listed(self.right)}; runs are paired by seed, so both sides need the same ones"
            )
        # Also policies of different training seeds must have run the same episodes.
        first, *others = (*self.left.members, *self.right.members)
        for other in others:
            require_same_episodes(first.name, first.result, other.name, other.result)
        _ = self.pairs

    @property
    def arms(self) -> tuple[Arm, Arm]:
        """Left and right."""
        return self.left, self.right

    @property
    def names(self) -> tuple[str, str]:
        """Names of both arms."""
        return self.left.name, self.right.name

    @cached_property
    def pairs(self) -> tuple[PairedComparison, ...]:
        """The paired comparison of each training seed."""
        members = zip(self.left.members, self.right.members, strict=True)
        return tuple(compare_results(a.result, b.result, self.names) for a, b in members)

    @property
    def difference(self) -> float:
        """Mean difference over training seeds, in [-1, 1]."""
        return fmean(pair.difference for pair in self.pairs)

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high) of `difference`: Newcombe's for one training seed, Student's over training seeds for more."""
        if len(self.pairs) == 1:
            return self.pairs[0].interval
        return mean_interval([pair.difference for pair in self.pairs], self.confidence)

    @cached_property
    def p_value(self) -> float:
        """Two-sided and exact over test episodes, all training seeds together; with one it is McNemar's.

        It holds for these trained policies; `interval` is about other training seeds, too.
        """
        margins: Counter[int] = Counter()
        for arm, sign in ((self.left, -1), (self.right, 1)):
            for episode in (one for member in arm.members for one in member.result.episodes):
                margins[episode.seed] += sign * episode.success
        return sign_flip_exact(list(margins.values()))

    @property
    def confidence(self) -> float:
        """Confidence of all intervals, and one minus the level of the tests."""
        return self.pairs[0].confidence

    @property
    def significant(self) -> bool:
        """Whether one arm is better by the exact test, and with several seeds by the t interval, too."""
        low, high = self.interval
        return self.p_value < 1 - self.confidence and (len(self.pairs) == 1 or low > 0 or high < 0)

    @property
    def verdict(self) -> str:
        """One sentence with the difference, its interval and p."""
        n, left, right = len(self.pairs), *self.names
        swapped = self.difference < 0
        better, worse = (left, right) if swapped else (right, left)
        each = f" on each of {n} training seeds" if n > 1 else ""
        tested = f"{format_p(self.p_value)}, {self.pairs[0].n:,} paired episodes{each}"
        over = f" on average over {n} training seeds (ahead in {self.ahead(better)} of {n})" if n > 1 else ""
        points = self._points(-1 if swapped else 1)
        if self.significant:
            return f"{better} is better than {worse} by {points}{over}, {tested}."
        if self.p_value < 1 - self.confidence:
            return (
                f"These policies of {better} are better than those of {worse} ({tested}), but {n} training seeds do "
                f"not show that others would be: {points}{over}."
            )
        if not self.difference:
            over = over.partition(" (")[0]
        return f"No difference shown between {right} and {left}: {self._points(1, '+')}{over}, {tested}."

    def ahead(self, name: str) -> int:
        """Return the number of training seeds in which the arm of this name has the higher success."""
        sign = 1 if name == self.right.name else -1
        return sum(sign * pair.difference > 0 for pair in self.pairs)

    def _points(self, sign: int, plus: str = "") -> str:
        low, high = sorted(100 * sign * end for end in self.interval)
        # z: no minus before a 0.0
        return f"{100 * sign * self.difference:{plus}z.1f} points [{low:{plus}z.1f}, {high:{plus}z.1f}]"

    @property
    def numbers(self) -> str:
        """`+4.2 points [+1.1, +7.3], p = 0.002`: right minus left."""
        return f"{self._points(1, '+')}, {format_p(self.p_value)}"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; differences are right minus left."""
        several = len(self.pairs) > 1
        return {
            "left": self.left.name,
            "right": self.right.name,
            "difference": self.difference,
            "interval": list(self.interval),
            "interval_method": "Student's t over training seeds" if several else "Newcombe's for paired proportions",
            "confidence": self.confidence,
            "p_value": self.p_value,
            "test": (
                "exact sign flips of test episodes, training seeds summed; conditional on these training seeds"
                if several
                else "McNemar's, exact"
            ),
            "only_left": sum(pair.only_left for pair in self.pairs),
            "only_right": sum(pair.only_right for pair in self.pairs),
            "left_ahead": self.ahead(self.left.name),
            "right_ahead": self.ahead(self.right.name),
            "n_episodes": self.pairs[0].n,
            "verdict": self.verdict,
            "training_seeds": [
                {"left_seed": left.training_seed, "right_seed": right.training_seed}
                | {"left": left.to_json(), "right": right.to_json()}
                | {key: getattr(pair, key) for key in _OF_PAIR}
                for left, right, pair in zip(self.left.members, self.right.members, self.pairs, strict=True)
            ],
        }


def require_same_episodes(left_name: str, left: EvalResult, right_name: str, right: EvalResult) -> None:
    """Raise `ManipError` with both numbers unless both ran exactly the same seeds."""
    ours, theirs = ({episode.seed for episode in one.episodes} for one in (left, right))
    if ours != theirs:
        raise ManipError(
            f"test episodes differ: {left_name} has {len(ours)}, {right_name} {len(theirs)}, of which "
            f"{len(ours & theirs)} are the same; evaluate both with the same --seed and --eval.n_episodes"
        )


def comparison_facts(comparison: Comparison, rule: Rule, limit: float | None) -> list[str]:
    """Return sentences on the rule by which rounds were chosen, and on the numbers over training seeds."""
    members = (*comparison.left.members, *comparison.right.members)
    rounds = [member.chosen for member in members if member.chosen is not None]
    return [*(rule_facts(rule, limit, rounds) if rounds else []), *seeds_facts(len(comparison.pairs))]


def seeds_facts(count: int) -> list[str]:
    """Return a sentence on the interval and the test over `count` training seeds; none for a single one."""
    if count == 1:
        return []
    return [
        f"The interval is Student's over {count} training seeds; with so few it is wide. "
        "p is exact over test episodes, which flip together for all training seeds, and holds for these policies alone."
    ]


def _listed(arm: Arm) -> str:
    if arm.training_seeds == [None]:
        return "one policy"
    return ", ".join("?" if seed is None else str(seed) for seed in arm.training_seeds)
