"""The rounds of a run and their costs, read from `metrics.jsonl`, and the choice of a round for
a comparison.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.intervals import Proportion

Cost = Literal["labels", "episodes", "steps", "seconds"]
COSTS: tuple[Cost, ...] = ("labels", "episodes", "steps", "seconds")
At = Literal["end", "labels", "episodes", "steps", "seconds"]
METRICS_FILE = "metrics.jsonl"


@dataclass(frozen=True)
class Round:
    """One round of DAgger, or one validated iteration of reinforcement learning.

    The costs are those of the run up to the end of the round.

    Attributes:
        round: Number of the round or iteration.
        labels: Number of expert labels.
        episodes: Number of collected episodes.
        steps: Number of simulated control steps.
        seconds: Time for collecting and fitting, without validation [s].
        validation: Success on the validation episodes.
        unit: Whether this is a round or an iteration.
    """

    round: int
    labels: int
    episodes: int
    steps: int
    seconds: float
    validation: Proportion
    unit: Literal["round", "iteration"] = "round"

    @property
    def folder(self) -> str:
        """Its folder in the run, which has the `eval.json` of its validation."""
        return (
            f"validation/{self.round:06d}"
            if self.unit == "iteration"
            else f"round_{self.round:03d}"
        )

    def amount(self, cost: Cost) -> float:
        """Return the labels, episodes, steps or seconds that the run had used by the end of this
        round.
        """
        return getattr(self, cost)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        success = {
            "validation_success": self.validation.rate,
            "validation_interval": list(self.validation.interval),
        }
        return (
            {"round": self.round} | {cost: round(self.amount(cost), 2) for cost in COSTS} | success
        )


History = tuple[Round, ...]


def history(records: Sequence[Mapping[str, Any]], name: str) -> History:
    """Return a run's rounds in order from the lines of its `metrics.jsonl`.

    Raises `ManipError` for invalid lines.

    For `manip-il rl gail`, `airl` and `ppo`, the rounds are the iterations that were validated.
    """
    unit: Literal["round", "iteration"] = (
        "iteration" if records and "iteration" in records[0] else "round"
    )
    rounds: list[Round] = []
    seconds = 0.0
    try:
        for record in sorted(records, key=lambda record: record[unit]):
            n = record["validation_episodes"]
            seconds += sum(
                spent for stage, spent in record["seconds"].items() if stage != "validate"
            )
            if record["validation_success"] is None:
                continue
            labels = record["labels"] if unit == "round" else 0  # reinforcement learning uses none
            validation = Proportion(round(record["validation_success"] * n), n)
            steps = record.get("steps", labels)
            rounds.append(
                Round(record[unit], labels, record["episodes"], steps, seconds, validation, unit)
            )
    except (KeyError, TypeError, UsageError) as error:
        raise ManipError(
            f"{name}: metrics.jsonl was not written by a run of manip-il ({error!r})"
        ) from error
    if not rounds:
        raise ManipError(f"{name} has no finished round yet; continue it with --resume=true")
    return tuple(rounds)


def costs_of(histories: Iterable[History]) -> list[Cost]:
    """Return the costs that runs had: labels only if there are any, steps only if some of them
    have no label.
    """
    rounds = [one for rounds in histories for one in rounds]
    absent = {
        "labels": not any(one.labels for one in rounds),
        "steps": all(one.steps == one.labels for one in rounds),
    }
    return [cost for cost in COSTS if not absent.get(cost)]


@dataclass(frozen=True)
class Rule:
    """The rule that chooses the round of each run, fixed before any test episode.

    Attributes:
        checkpoint: The last round, or the one with the highest validation success (the later one
            if equal).
        at: `end` allows all rounds; a cost, such as `labels`, allows rounds that used at most
            `limit` of it.
        limit: The largest amount of this cost that every run reached.
    """

    checkpoint: Literal["best", "last"] = "best"
    at: At = "end"
    limit: float | None = None

    def limited(self, histories: Mapping[str, History]) -> Rule:
        """Return the rule, limited to the cost that all runs reached.

        Raises `UsageError` for a run without rounds.
        """
        if self.at == "end":
            return self
        if name := next((name for name, rounds in histories.items() if not rounds), None):
            raise UsageError(f"--at={self.at}: {name} has no rounds; give a run of manip-il dagger")
        return replace(self, limit=min(rounds[-1].amount(self.at) for rounds in histories.values()))

    def select(self, rounds: History, name: str) -> Round:
        """Return the round of a run that the rule chooses.

        Raises `UsageError` if none ended within the limit.
        """
        if self.at != "end" and self.limit is not None:
            first = rounds[0].amount(self.at)
            rounds = tuple(one for one in rounds if one.amount(self.at) <= self.limit)
            if not rounds:
                reached, most = format_amount(self.at, first), format_amount(self.at, self.limit)
                raise UsageError(
                    f"--at={self.at}: the first round of {name} ends at {reached}, but another run"
                    f" ended at {most}"
                )
        if self.checkpoint == "last":
            return rounds[-1]
        return max(rounds, key=lambda one: (one.validation.rate, one.round))

    @property
    def fact(self) -> str:
        """A sentence that states the rule."""
        which = "last round" if self.checkpoint == "last" else "round that was best on validation"
        words = f"The {which} of each run was tested, chosen before the test"
        if self.at == "end" or self.limit is None:
            return f"{words}."
        return (
            f"{words} among those within {format_amount(self.at, self.limit)}, which every run"
            " reached."
        )


def format_amount(cost: Cost, amount: float) -> str:
    """Return `8,012 labels`, `150 episodes`, `8,012 steps` or `200 seconds`."""
    return f"{amount:,.0f} {cost}"
