"""The rounds of a run, read from `metrics.jsonl`, and the choice of one for a comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.report_data import COSTS, Cost, CurvePoint, format_amount

END = "end"
ENOUGH = 0.95  # share of an amount that a run must have reached to be compared at it: rounds are not that fine
UNEQUAL = 1.05  # factor from which on the costs of chosen rounds are said to differ
_MOST = 10**12  # labels, episodes


@dataclass(frozen=True)
class Round:
    """One round of DAgger, or one validated iteration of reinforcement learning, and the run's costs up to its end.

    seconds: of collecting and fitting; validating is counted apart, as it is no part of the method.
    """

    round: int
    labels: int
    queries: int
    episodes: int
    steps: int
    seconds: float
    validating: float  # [s]
    validation: Proportion
    unit: Literal["round", "iteration"] = "round"

    @property
    def name(self) -> str:
        """Return `round 3` or `iteration 120`."""
        return f"{self.unit} {self.round}"

    def amount(self, axis: Cost) -> float:
        """Return the labels, episodes, simulated control steps or seconds that the run had used."""
        return getattr(self, axis)

    def after(self, start: Round, *, fitted: float) -> Round:
        """Return the round as of a run that began with what another's round 0 made. fitted: that took besides [s]."""
        sums = {name: getattr(self, name) + getattr(start, name) for name in ("labels", "queries", "episodes", "steps")}
        return replace(self, **sums, seconds=self.seconds + fitted)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "round": self.round,
            "labels": self.labels,
            "queries": self.queries,
            "episodes": self.episodes,
            "steps": self.steps,
            "seconds": round(self.seconds, 2),
            "validating_seconds": round(self.validating, 2),
            "validation_success": self.validation.rate,
            "validation_interval": list(self.validation.interval),
        }


History = tuple[Round, ...]


def history(records: Sequence[Mapping[str, Any]], name: str) -> History:
    """Return a run's rounds in order from the lines of its `metrics.jsonl`; `ManipError` where they are not a run's.

    Of `manip-il gail`, `airl` and `ppo` those iterations are rounds that were validated.
    """
    if not records:
        raise ManipError(f"{name} has no finished round yet; continue it with --resume=true")
    unit = "iteration" if "iteration" in records[0] else "round"
    records = sorted(records, key=lambda record: _number(record, unit))
    first = min(1, max(0, _number(records[0], unit))) if unit == "iteration" else 0
    rounds: list[Round] = []
    seconds = validating = 0.0
    for number, record in enumerate(records, start=first):
        if _number(record, unit) != number:
            raise ManipError(f"{name}: metrics.jsonl has no {unit} {number}; expected one line {_a(unit)}")
        try:
            times = checks.mapping("seconds", record["seconds"])
            seconds += sum(checks.number(part, times[part], 0) for part in ("collect", "fit"))
            validating += checks.number("validate", times["validate"], 0)
            if unit == "round" or record["validation_success"] is not None:
                rounds.append(_round(record, number, seconds, validating, unit))
        except (KeyError, ManipError) as error:
            why = f"no {error}, {unit} {number}" if isinstance(error, KeyError) else f"{unit} {number}: {error}"
            raise ManipError(f"{name}: metrics.jsonl was not written by a run of manip-il ({why})") from error
    if not rounds:
        raise ManipError(f"{name} has no validated iteration yet; continue it with --resume=true")
    return tuple(rounds)


def _round(
    record: Mapping[str, Any], number: int, seconds: float, validating: float, unit: Literal["round", "iteration"]
) -> Round:
    count = checks.whole("validation_episodes", record["validation_episodes"], 1, _MOST)
    success = checks.number("validation_success", record["validation_success"], 0, 1)
    labels = checks.whole("labels", record["labels"], 0, _MOST) if unit == "round" else 0  # which asks for none
    queries = checks.whole("queries", record.get("queries", labels), 0, _MOST)
    return Round(
        round=number,
        labels=labels,
        queries=queries,
        episodes=checks.whole("episodes", record["episodes"], 0, _MOST),
        steps=checks.whole("steps", record.get("steps", queries), 0, _MOST),
        seconds=seconds,
        validating=validating,
        validation=Proportion(round(success * count), count),
        unit=unit,
    )


def _number(record: Mapping[str, Any], unit: str) -> int:
    """Number of a line's round; -1 where it has none."""
    number = record.get(unit)
    return number if isinstance(number, int) else -1


def _a(unit: str) -> str:
    return f"{'an' if unit == 'iteration' else 'a'} {unit}"


def curve_points(rounds: History) -> tuple[CurvePoint, ...]:
    """Return a run's learning curve, with all costs; without steps where the expert was queried in each of them."""
    steps = [one.steps if unasked(rounds) else None for one in rounds]
    return tuple(
        CurvePoint(one.labels, one.validation, one.name, one.episodes, one.seconds, count)
        for one, count in zip(rounds, steps, strict=True)
    )


def unasked(rounds: History) -> bool:
    """Return whether steps were simulated in which the expert was not queried, so that they are a cost of their own."""
    return any(one.steps != one.queries for one in rounds)


@dataclass(frozen=True)
class Rule:
    """The rule that chooses the round of each run, fixed before any test episode.

    checkpoint: the last round, or the one with the highest validation success (of equals the later). axis: rounds
    count up to an equal amount of this; `end`: all do. amount: that amount; None: the largest that every run reached.
    """

    checkpoint: Literal["best", "last"] = "best"
    axis: Cost | Literal["end"] = END
    amount: float | None = None

    @classmethod
    def parse(cls, checkpoint: Literal["best", "last"], at: str) -> Rule:
        """Parse `--at=`: `end`, `labels`, `episodes`, `steps` or `seconds`, these with an amount too, `labels:5000`."""
        axis, colon, text = at.partition(":")
        known = (END, *COSTS)
        if axis not in known:
            raise UnknownName("way to compare", axis, known)
        if not colon:
            return cls(checkpoint, axis)
        try:
            amount = float(text)
        except ValueError:
            amount = math.nan
        if axis == END or not 0 < amount < math.inf:
            raise UsageError(f"--at is {at!r}; expected {', '.join(known)}, or an amount as in labels:5000")
        return cls(checkpoint, axis, amount)

    def __str__(self) -> str:
        return self.axis if self.amount is None else f"{self.axis}:{self.amount:g}"

    @property
    def words(self) -> str:
        """Return the cost and its amount, `20,000 steps`."""
        return self.axis if self.axis == END or self.amount is None else format_amount(self.axis, self.amount)


def budget(rule: Rule, histories: Sequence[History]) -> float | None:
    """Return how much of `rule.axis` every run may use: as given, or the most that all reached; None for no limit.

    Raises `UsageError` where a run ended before the share `ENOUGH` of what is given.
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


def rounds_within(rule: Rule, rounds: History, limit: float | None) -> History:
    """Return the rounds that ended within `limit` of the rule's cost; all without a limit."""
    axis = rule.axis
    return rounds if axis == END or limit is None else tuple(one for one in rounds if one.amount(axis) <= limit)


def select_round(rule: Rule, rounds: History, limit: float | None, name: str) -> Round:
    """Return the round of one run that `rule` chooses; `UsageError` where none ended within `limit`."""
    within, axis = rounds_within(rule, rounds, limit), rule.axis
    if not within and axis != END and limit is not None:
        raise UsageError(
            f"--at={rule}: {name} has no round within {format_amount(axis, limit)}; "
            f"its first took {format_amount(axis, rounds[0].amount(axis))}"
        )
    if rule.checkpoint == "last":
        return within[-1]
    return max(within, key=lambda one: (one.validation.rate, one.round))


def rule_facts(rule: Rule, limit: float | None, chosen: Sequence[Round]) -> list[str]:
    """Return sentences on the rule, and on costs of the chosen rounds that are not the same."""
    which = "last round" if rule.checkpoint == "last" else "round that was best on validation"
    words = f"Of every run the {which}, chosen before the test"
    if rule.axis == END or limit is None:
        return [f"{words}."]
    source = "given" if rule.amount is not None else "the most that every run reached"
    facts = [f"{words}, within {format_amount(rule.axis, limit)} ({source})."]
    amounts = [one.amount(rule.axis) for one in chosen]
    low, high = min(amounts), max(amounts)
    if high > UNEQUAL * low:
        spent = f"{format_amount(rule.axis, low).removesuffix(f' {rule.axis}')} to {format_amount(rule.axis, high)}"
        facts.append(
            f"The rounds taken had used {spent}: the best one may come early, and a round that would have gone over "
            "the limit does not count."
        )
    return facts


def first_reaching(rounds: History, target: float) -> Round | None:
    """Return the first round with at least this validation success; None where none got there."""
    return next((one for one in rounds if one.validation.rate >= target), None)


def largest_dip(rounds: History) -> float:
    """Return how far validation success fell at most below the best before it, 0 to 1."""
    best, dip = 0.0, 0.0
    for one in rounds:
        dip, best = max(dip, best - one.validation.rate), max(best, one.validation.rate)
    return dip
