"""An arm of a comparison: one policy, or one per training seed, as evaluations, checkpoints or whole runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from manip_il.collect.workers import Engine
from manip_il.data.fingerprint import policy_sha256
from manip_il.data.json_lines import read_lines
from manip_il.errors import UsageError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.evaluation.results import FILE_NAME, EvalResult, require_equal
from manip_il.evaluation.rounds import METRICS_FILE, History, Round, Rule, history
from manip_il.evaluation.runner import FOLDER, Progress, Trial
from manip_il.option import NameOrPath
from manip_il.sim.conditions import Condition
from manip_il.tasks.config import EnvConfig

_SEED_FOLDER = re.compile(r"seed_(\d+)")


@dataclass(frozen=True)
class Member:
    """One policy of an arm: an evaluation, a checkpoint, or a run from which a rule chooses a round.

    policy: its folder; None for an evaluation, and for a run before its round is chosen. result: None until measured.
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

    def select(self, rule: Rule) -> Member:
        """Return the member with the policy of the round that `rule` chooses. Raises `UsageError` if there is none."""
        if not self.history:
            return self
        chosen = rule.select(self.history, self.name)
        folder = _round_folder(self.path, chosen)
        policy = find_policy(folder if chosen.unit == "iteration" else folder / "policy")
        return replace(self, chosen=chosen, policy=policy)

    def measure(self, trial: Trial, folder: Path, engine: Engine, progress: Progress) -> Member:
        """Return the member with its policy's evaluation, saved in `folder`; the member itself if it has no policy."""
        if self.policy is None:
            return self
        words = f"{re.sub(r'[^A-Za-z0-9]+', '_', self.name)[-80:]}_{policy_sha256(self.policy)[:8]}"
        result = trial.measure(self.policy, self.name, folder / FOLDER / words, engine, progress)
        return replace(self, result=result)

    def env(
        self, robot: NameOrPath | None = None, task: NameOrPath | None = None, shape: NameOrPath | None = None
    ) -> EnvConfig:
        """Return the environment in which the member's run was validated.

        robot, task, shape: the user's own files, because results hold only the names of these.
        """
        found = EvalResult.read(_round_folder(self.path, self.history[0]))
        return found.settings.env(robot or found.robot, task or found.task, shape)

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Conditions under which the member's run was validated."""
        return EvalResult.read(_round_folder(self.path, self.history[0])).settings.conditions

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        rounds, chosen = [one.to_json() for one in self.history], self.chosen and self.chosen.to_json()
        known = {"seed": self.training_seed, "name": self.name, "policy": self.policy and str(self.policy)}
        return known | {"chosen": chosen} | self.test.success.to_json() | {"rounds": rounds}


@dataclass(frozen=True)
class Arm:
    """One side of a comparison: one policy, or one per training seed."""

    name: str
    members: tuple[Member, ...]

    @property
    def test_rate(self) -> float:
        """Mean success over training seeds."""
        return fmean(member.test.success.rate for member in self.members)

    @property
    def has_histories(self) -> bool:
        """Whether every policy comes from a run."""
        return all(member.history for member in self.members)

    def measure(self, trial: Trial, folder: Path, engine: Engine, progress: Progress) -> Arm:
        """Return the arm with its policies' evaluations, see `Member.measure`."""
        return replace(self, members=tuple(one.measure(trial, folder, engine, progress) for one in self.members))


def select_rounds(rule: Rule, arms: Sequence[Arm]) -> tuple[Rule, tuple[Arm, ...]]:
    """Return the rule with the cost limit that all runs share, and the arms with the rounds that the rule chooses."""
    rule = rule.limited({member.name: member.history for arm in arms for member in arm.members})
    return rule, tuple(replace(arm, members=tuple(one.select(rule) for one in arm.members)) for arm in arms)


def read_arm(path: Path) -> Arm:
    """Return the arm at `path`. Raises a one-line `UsageError` if it cannot be compared."""
    folders = [folder for folder in path.iterdir() if folder.is_dir()] if path.is_dir() else []
    seeds = {int(match[1]): folder for folder in folders if (match := _SEED_FOLDER.fullmatch(folder.name))}
    if not seeds:
        return Arm(str(path), (read_member(path),))
    members = (replace(read_member(folder), training_seed=seed) for seed, folder in sorted(seeds.items()))
    return Arm(str(path), tuple(members))


def require_pair(left: Arm, right: Arm) -> None:
    """Raise `UsageError` unless two arms can be compared.

    Both must be evaluations, or both policies to evaluate, with the same training seeds; the seeds of two arms with one
    policy each may differ.
    """
    if len({member.result is None for arm in (left, right) for member in arm.members}) > 1:
        raise UsageError(
            f"{left.name} and {right.name}: only one of them is an evaluation; give two eval.json, or two policies"
        )
    ours, theirs = ([member.training_seed for member in arm.members] for arm in (left, right))
    if len(ours) != len(theirs) or (len(ours) > 1 and ours != theirs):
        raise UsageError(f"training seeds differ: {left.name} has {ours}, {right.name} {theirs}; give the same ones")


def require_same_env(envs: Mapping[str, EnvConfig]) -> EnvConfig:
    """Return the environment that all arms or runs share. Raises `MismatchError` for the first difference.

    envs: name of an arm or run -> its environment.
    """
    (first, env), *others = envs.items()
    for name, other in others:
        require_equal(first, env, name, other, *(field.name for field in fields(env)))
    return env


def read_member(path: Path) -> Member:
    """Return the policy, run or evaluation at `path`. Raises `UsageError` if there is none."""
    if path.is_file():
        return Member(path, result=EvalResult.read(path))
    records = read_lines(path / METRICS_FILE)
    if any({"round", "iteration"} & record.keys() for record in records):  # `manip-il train` logs only steps
        return Member(path, history=history(records, str(path)))
    if (path / FILE_NAME).is_file():
        return Member(path, result=EvalResult.read(path))
    try:
        return Member(path, policy=find_policy(path))
    except UsageError:
        expected = "an eval.json, a policy, a run of manip-il dagger, or a folder of seed_0, seed_1, ... of these"
        raise UsageError(f"{path} holds nothing to compare; expected {expected}") from None


def _round_folder(run: Path, one: Round) -> Path:
    """Return the folder of a run's round or validated iteration; it has the `eval.json` of its validation."""
    return run / "validation" / f"{one.round:06d}" if one.unit == "iteration" else run / f"round_{one.round:03d}"
