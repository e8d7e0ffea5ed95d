"""The rounds of a DAgger run as `metrics.jsonl` tells them, and which of them a comparison takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.evaluation.report_data import COSTS, Cost, CurvePoint, format_amount
from manip_il.evaluation.statistics import Proportion

END = "end"
_MOST = 10**12  # labels, episodes: beyond it a number is a slip


@dataclass(frozen=True)
class Round:
    """One round, and what the run had cost when it ended.

    labels, queries, episodes: so far. seconds: so far, of collecting and fitting; validating is counted apart, as it
    measures the run and is no part of it.
    """

    round: int
    labels: int
    queries: int
    episodes: int
    seconds: float
    validating: float  # so far [s]
    validation: Proportion

    def amount(self, axis: Cost) -> float:
        """What the run had used of labels, episodes or seconds."""
        return {"labels": self.labels, "episodes": self.episodes, "seconds": self.seconds}[axis]

    @property
    def words(self) -> str:
        """`round 3: 8,012 labels, 150 episodes, 2 min 05 s`."""
        return f"round {self.round}: {', '.join(format_amount(axis, self.amount(axis)) for axis in COSTS)}"

    def to_json(self) -> dict[str, Any]:
        """For `compare.json` and `study.json`."""
        return {
            "round": self.round,
            "labels": self.labels,
            "queries": self.queries,
            "episodes": self.episodes,
            "seconds": round(self.seconds, 2),
            "validating_seconds": round(self.validating, 2),
            "validation_success": self.validation.rate,
            "validation_interval": list(self.validation.interval),
        }


History = tuple[Round, ...]


def history(records: Sequence[Mapping[str, Any]], name: str) -> History:
    """Return a run's rounds in order from the lines of its `metrics.jsonl`.

    `ManipError` where they are none of a run.
    """
    if not records:
        raise ManipError(f"{name} has no finished round yet; continue with manip-il dagger --resume=true")
    rounds: list[Round] = []
    seconds = validating = 0.0
    for number, record in enumerate(sorted(records, key=_number)):
        if _number(record) != number:
            raise ManipError(f"{name}: metrics.jsonl has no round {number}; expected one line a round")
        try:
            times = checks.mapping("seconds", record["seconds"])
            seconds += sum(checks.number(part, times[part], 0) for part in ("collect", "fit"))
            validating += checks.number("validate", times["validate"], 0)
            count = checks.whole("validation_episodes", record["validation_episodes"], 1, _MOST)
            success = checks.number("validation_success", record["validation_success"], 0, 1)
            rounds.append(
                Round(
                    round=number,
                    labels=checks.whole("labels", record["labels"], 0, _MOST),
                    queries=checks.whole("queries", record.get("queries", record["labels"]), 0, _MOST),
                    episodes=checks.whole("episodes", record["episodes"], 0, _MOST),
                    seconds=seconds,
                    validating=validating,
                    validation=Proportion(round(success * count), count),
                )
            )
        except KeyError as error:
            raise ManipError(
                f"{name}: metrics.jsonl was not written by manip-il dagger (no {error}, round {number})"
            ) from error
        except ManipError as error:
            raise ManipError(
                f"{name}: metrics.jsonl was not written by manip-il dagger (round {number}: {error})"
            ) from error
    return tuple(rounds)


def _number(record: Mapping[str, Any]) -> int:
    """Of the round that a line is about; -1 where it says none."""
    number = record.get("round")
    return number if isinstance(number, int) else -1


def curve_points(rounds: History) -> tuple[CurvePoint, ...]:
    """Return a run's learning curve, with all that it had cost."""
    return tuple(
        CurvePoint(one.labels, one.validation, f"round {one.round}", one.episodes, one.seconds) for one in rounds
    )


ENOUGH = 0.95  # of an amount that runs are compared at: rounds do not end on the dot


@dataclass(frozen=True)
class Rule:
    """Which round of a run is compared; the same for every run, and fixed before any test episode is seen.

    checkpoint: the last round, or the one with the highest validation success (of equals the later). axis: rounds
    count up to an equal amount of this; `end`: all do. amount: that amount; None: the largest that every run reached.
    """

    checkpoint: Literal["best", "last"] = "best"
    axis: Cost | Literal["end"] = END
    amount: float | None = None

    @classmethod
    def parse(cls, checkpoint: Literal["best", "last"], at: str) -> Rule:
        """From `--at=`: `end`, `labels`, `episodes`, `seconds`, or such a name with an amount, `labels:5000`."""
        axis, colon, text = at.partition(":")
        known = (END, *COSTS)
        if axis not in known:
            raise UnknownName("way to compare: --at", axis, known)
        if not colon:
            return cls(checkpoint, axis)
        try:
            amount = float(text)
        except ValueError:
            amount = math.nan
        if axis == END or not 0 < amount < math.inf:
            raise UsageError(f"--at is {at!r}; expected end, labels, episodes, seconds, or an amount as in labels:5000")
        return cls(checkpoint, axis, amount)

    @property
    def words(self) -> str:
        """For the report's facts."""
        which = "last round" if self.checkpoint == "last" else "round that was best on validation"
        return f"Of every run the {which}, chosen before the test"

    def __str__(self) -> str:
        return self.axis if self.amount is None else f"{self.axis}:{self.amount:g}"


def budget(rule: Rule, histories: Sequence[History]) -> float | None:
    """Return how much of `rule.axis` every run may have used: given, or the largest that all reached.

    None for no limit.

    Raises `UsageError` where a run ended at less than `ENOUGH` of what is given.
    """
    if rule.axis == END:
        return None
    reached = min(rounds[-1].amount(rule.axis) for rounds in histories)
    if rule.amount is not None and reached < ENOUGH * rule.amount:
        raise UsageError(
            f"--at={rule}: not every run got that far, one ended at {format_amount(rule.axis, reached)}; "
            f"--at={rule.axis} takes the most that all reached"
        )
    return reached if rule.amount is None else rule.amount


def choose(rule: Rule, rounds: History, limit: float | None, name: str) -> Round:
    """Return the round that `rule` takes of one run; `UsageError` where none ended within `limit`."""
    within = [one for one in rounds if rule.axis == END or limit is None or one.amount(rule.axis) <= limit]
    if not within:
        assert rule.axis != END
        raise UsageError(
            f"--at={rule}: {name} has no round within {format_amount(rule.axis, limit or 0)}; "
            f"its first took {format_amount(rule.axis, rounds[0].amount(rule.axis))}"
        )
    if rule.checkpoint == "last":
        return within[-1]
    return max(within, key=lambda one: (one.validation.rate, one.round))


def first_reaching(rounds: History, target: float) -> Round | None:
    """Return the first round with at least this validation success; None where none got there."""
    return next((one for one in rounds if one.validation.rate >= target), None)


def largest_dip(rounds: History) -> float:
    """Return how far validation success fell, in any round, below the best before it.

    0 where it never did, at most 1.
    """
    best, dip = 0.0, 0.0
    for one in rounds:
        dip, best = max(dip, best - one.validation.rate), max(best, one.validation.rate)
    return dip
