"""A side of a comparison or a row of a report: one policy, or one per training seed, and the
rounds of their runs.

Rounds and their costs are read from `metrics.jsonl`; a rule chooses the round of each run.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

from manip_il.data.atomic import read_lines
from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.results import FILE_NAME, EvalResult, require_equal
from manip_il.learn.checkpoint import find_policy
from manip_il.worlds.config import EnvConfig

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


_SEED_FOLDER = re.compile(r"seed_(\d+)")


@dataclass(frozen=True)
class Member:
    """One policy of a side: an evaluation, a checkpoint, or a run of which a rule chooses a round.

    Attributes:
        path: The evaluation, checkpoint or run.
        training_seed: The seed that the policy was trained with, if known.
        history: The rounds of a run; empty for an evaluation and for a checkpoint.
        policy: Folder of the policy; None for an evaluation, and for a run before its round is
            chosen.
        chosen: The round that was chosen; None for an evaluation, for a checkpoint, and for a run
            before its round is chosen.
        result: The evaluation; None until measured.
    """

    path: Path
    training_seed: int | None = None
    history: History = ()
    policy: Path | None = None
    chosen: Round | None = None
    result: EvalResult | None = None

    @property
    def name(self) -> str:
        """The path, for tables and errors."""
        return str(self.path)

    @property
    def test(self) -> EvalResult:
        """The evaluation of a member that has been measured."""
        assert self.result is not None
        return self.result

    @property
    def validation(self) -> EvalResult:
        """The validation of the run's first round, in the environment and conditions of all of
        them.
        """
        return EvalResult.read(self.path / self.history[0].folder)

    def select(self, rule: Rule) -> Member:
        """Return the member with the policy of the round that `rule` chooses.

        Raises `UsageError` if there is none.
        """
        if not self.history:
            return self
        chosen = rule.select(self.history, self.name)
        folder = self.path / chosen.folder
        return replace(
            self,
            chosen=chosen,
            policy=find_policy(folder / "policy" if chosen.unit == "round" else folder),
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "seed": self.training_seed,
            "name": self.name,
            "policy": self.policy and str(self.policy),
            "chosen": self.chosen and self.chosen.to_json(),
            **self.test.success.to_json(),
            "rounds": [one.to_json() for one in self.history],
        }


@dataclass(frozen=True)
class Side:
    """One policy, or one per training seed, as reports and comparisons show it.

    Attributes:
        name: Name of the side.
        members: The policies, one per training seed.
        labels: Number of expert labels that a policy learnt from, if known.
        disturbed: The policy's evaluation under a disturbance, if any.
    """

    name: str
    members: tuple[Member, ...]
    labels: int | None = None
    disturbed: EvalResult | None = None

    @classmethod
    def of(cls, name: str, result: EvalResult, **more: Any) -> Side:
        """Return the side of one evaluation.

        Args:
            name: Name of the side.
            result: The evaluation.
            more: Other fields.
        """
        return cls(name, (Member(Path(name), result=result),), **more)

    @property
    def results(self) -> tuple[EvalResult, ...]:
        """The evaluation of each member."""
        return tuple(member.test for member in self.members)

    @property
    def rate(self) -> float:
        """Mean success over training seeds."""
        return fmean(result.success.rate for result in self.results)

    @property
    def by_task(self) -> dict[str, list[Proportion]]:
        """The success of each training seed at each of several tasks, {} if there is one."""
        tasks = self.results[0].by_task
        return {task: [result.by_task[task].success for result in self.results] for task in tasks}

    @property
    def histories(self) -> tuple[History, ...]:
        """The rounds of each member; empty unless all are runs."""
        runs = tuple(member.history for member in self.members)
        return runs if all(runs) else ()


def select_rounds(rule: Rule, sides: Sequence[Side]) -> tuple[Rule, tuple[Side, ...]]:
    """Return the rule with the cost limit that all runs share, and the sides with the rounds
    that the rule chooses.
    """
    rule = rule.limited({member.name: member.history for side in sides for member in side.members})
    return rule, tuple(
        replace(side, members=tuple(one.select(rule) for one in side.members)) for side in sides
    )


def read_side(path: Path, name: str = "") -> Side:
    """Return the side at `path`. Raises a one-line `UsageError` if it cannot be compared."""
    folders = path.iterdir() if path.is_dir() else ()
    seeds = {
        int(match[1]): one
        for one in folders
        if (match := _SEED_FOLDER.fullmatch(one.name)) and one.is_dir()
    }
    members = [
        replace(read_member(folder), training_seed=seed) for seed, folder in sorted(seeds.items())
    ]
    return Side(name or str(path), tuple(members) or (read_member(path),))


def read_member(path: Path) -> Member:
    """Return the policy, run or evaluation at `path`. Raises `UsageError` if there is none."""
    records = read_lines(path / METRICS_FILE) if path.is_dir() else []
    # `manip-il train` logs only steps
    if any({"round", "iteration"} & record.keys() for record in records):
        return Member(path, history=history(records, str(path)))
    if path.is_file() or (path / FILE_NAME).is_file():
        return Member(path, result=EvalResult.read(path))
    return Member(path, policy=find_policy(path))


def require_pair(left: Side, right: Side) -> None:
    """Raise `UsageError` unless two sides can be compared.

    Both must be evaluations, or both policies to evaluate, with the same training seeds; the seeds
    of two sides with one policy each may differ.
    """
    if len({member.result is None for side in (left, right) for member in side.members}) > 1:
        raise UsageError(
            f"{left.name} and {right.name}: only one of them is an evaluation; give two eval.json,"
            " or two policies"
        )
    ours, theirs = ([member.training_seed for member in side.members] for side in (left, right))
    if len(ours) != len(theirs) or (len(ours) > 1 and ours != theirs):
        raise UsageError(
            f"training seeds differ: {left.name} has {ours}, {right.name} {theirs}; give the same"
            " ones"
        )


def require_same_env(envs: Mapping[str, EnvConfig]) -> EnvConfig:
    """Return the environment that all sides or runs share.

    Args:
        envs: Name of a side or run -> its environment.

    Raises:
        MismatchError: for the first difference.
    """
    (first, env), *others = envs.items()
    for name, other in others:
        require_equal(first, env, name, other, *(field.name for field in fields(env)))
    return env
