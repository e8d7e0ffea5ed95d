"""The rounds of a run and their costs, read from `metrics.jsonl`, and the choice of one for a comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.evaluation.intervals import Proportion

Cost = Literal["labels", "episodes", "steps", "seconds"]
COSTS: tuple[Cost, ...] = ("labels", "episodes", "steps", "seconds")
METRICS_FILE = "metrics.jsonl"
END = "end"
ENOUGH = 0.95  # share of an amount that a run must have reached to be compared at it: rounds are not that fine


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


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of a run's `metrics.jsonl`, without one that a kill cut short; none if there is no file."""
    path = folder / METRICS_FILE
    lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
    whole = [line for line in lines if line.endswith(b"\n")]
    return [checks.mapping(str(path), checks.parse_json(str(path), line)) for line in whole]


def history(records: Sequence[Mapping[str, Any]], name: str) -> History:
    """Return a run's rounds in order from the lines of its `metrics.jsonl`; `ManipError` if they are not a run's.

    Of `manip-il rl gail`, `airl` and `ppo` those iterations are rounds that were validated.
    """
    unit: Literal["round", "iteration"] = "iteration" if records and "iteration" in records[0] else "round"
    rounds: list[Round] = []
    seconds = validating = 0.0
    try:
        for record in sorted(records, key=lambda record: record[unit]):
            times, n = record["seconds"], record["validation_episodes"]
            seconds += times["collect"] + times["fit"]
            validating += times["validate"]
            if record["validation_success"] is None:
                continue
            labels = record["labels"] if unit == "round" else 0  # reinforcement learning asks for none
            queries = record.get("queries", labels)
            costs = (labels, queries, record["episodes"], record.get("steps", queries), seconds, validating)
            validation = Proportion(round(record["validation_success"] * n), n)
            rounds.append(Round(record[unit], *costs, validation, unit))
    except (KeyError, TypeError, UsageError) as error:
        raise ManipError(f"{name}: metrics.jsonl was not written by a run of manip-il ({error!r})") from error
    if not rounds:
        raise ManipError(f"{name} has no finished round yet; continue it with --resume=true")
    return tuple(rounds)


def has_unqueried_steps(rounds: History) -> bool:
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

    def limit(self, histories: Mapping[str, History]) -> float | None:
        """Return how much of the axis every run (name -> rounds) may use: as given, or the most that all reached.

        None for no limit. Raises `UsageError` if one has no rounds, or ended before nearly what is given.
        """
        if self.axis == END:
            return None
        for name, rounds in histories.items():
            if not rounds:
                raise UsageError(f"--at={self}: {name} has no rounds; give a run of manip-il dagger")
        reached = min(rounds[-1].amount(self.axis) for rounds in histories.values())
        if self.amount is not None and reached < ENOUGH * self.amount:
            raise UsageError(
                f"--at={self}: not every run got that far, one ended at {format_amount(self.axis, reached)}; "
                f"--at={self.axis} takes the most that all reached"
            )
        return reached if self.amount is None else self.amount

    def within(self, rounds: History, limit: float | None) -> History:
        """Return the rounds that ended within `limit` of the rule's cost; all without a limit."""
        axis = self.axis
        return rounds if axis == END or limit is None else tuple(one for one in rounds if one.amount(axis) <= limit)

    def select(self, rounds: History, limit: float | None, name: str) -> Round:
        """Return the round of one run that the rule chooses; `UsageError` if none ended within `limit`."""
        within = self.within(rounds, limit)
        if not within and self.axis != END and limit is not None:
            raise UsageError(
                f"--at={self}: {name} has no round within {format_amount(self.axis, limit)}; "
                f"its first took {format_amount(self.axis, rounds[0].amount(self.axis))}"
            )
        if self.checkpoint == "last":
            return within[-1]
        return max(within, key=lambda one: (one.validation.rate, one.round))

    def fact(self, limit: float | None) -> str:
        """Return a sentence on the rule."""
        which = "last round" if self.checkpoint == "last" else "round that was best on validation"
        words = f"Of every run the {which}, chosen before the test"
        if self.axis == END or limit is None:
            return f"{words}."
        source = "given" if self.amount is not None else "the most that every run reached"
        return f"{words}, within {format_amount(self.axis, limit)} ({source})."

    def to_json(self, limit: float | None) -> dict[str, Any]:
        """Return the rule as `compare.json` and `study.json` hold it."""
        return {"checkpoint": self.checkpoint, "at": str(self), "limit": limit}


def largest_dip(rounds: History) -> float:
    """Return how far validation success fell at most below the best before it, 0 to 1."""
    best, dip = 0.0, 0.0
    for one in rounds:
        dip, best = max(dip, best - one.validation.rate), max(best, one.validation.rate)
    return dip


def format_seconds(seconds: float) -> str:
    """Return a duration as `4.2 s`, `3 min 20 s` or `1 h 05 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def format_amount(cost: Cost, amount: float) -> str:
    """Return `8,012 labels`, `150 episodes`, `8,012 steps` or `3 min 20 s`."""
    return format_seconds(amount) if cost == "seconds" else f"{amount:,.0f} {cost}"
