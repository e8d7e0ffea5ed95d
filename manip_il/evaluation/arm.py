"""An arm of a comparison: one policy, or one for each training seed, as evaluations, checkpoints or whole runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from manip_il import checks
from manip_il.collect.workers import Engine
from manip_il.data.json_lines import read_lines
from manip_il.data.schema import OWN_OBJECT
from manip_il.errors import MismatchError, UsageError
from manip_il.evaluation.policy_folder import EXPECTED, find_policy, require_source
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.evaluation.rounds import METRICS_FILE, History, Round, Rule, history
from manip_il.evaluation.runner import Progress, Trial
from manip_il.tasks.config import EnvConfig, make_config

CONFIG_FILE = "config.yaml"
_SEED_FOLDER = re.compile(r"seed_(\d+)")


@dataclass(frozen=True)
class Member:
    """One policy of an arm: an evaluation, a checkpoint, or a run of which a rule selects a round.

    training_seed: None if nothing says it. policy: its folder, None for an evaluation, and for a run before its round
    is selected (`chosen`). env: of a run, None if its options are not beside it. result, file: its evaluation, once
    there is one. finished: whether a run has ended.
    """

    path: Path
    training_seed: int | None = None
    policy: Path | None = None
    history: History = ()
    env: EnvConfig | None = None
    finished: bool = True
    chosen: Round | None = None
    result: EvalResult | None = None
    file: Path | None = None

    @property
    def name(self) -> str:
        """Path, for tables and errors."""
        return str(self.path)

    @property
    def test(self) -> EvalResult:
        """The evaluation, of a member that has been measured."""
        assert self.result is not None
        return self.result

    def select(self, rule: Rule, limit: float | None) -> Member:
        """Return the member with the policy of the round that `rule` selects; `UsageError` if there is none."""
        if not self.history:
            return self
        chosen = rule.select(self.history, limit, self.name)
        return replace(self, chosen=chosen, policy=_round_policy(self.path, chosen))

    def measure(self, trial: Trial | None, folder: Path, engine: Engine, progress: Progress) -> Member:
        """Return the member with the evaluation of its policy, which is stored in `folder`; itself without a trial."""
        if self.policy is None or trial is None:
            return self
        file = trial.file(folder, self.policy)
        result = trial.measure(self.policy, self.name, file, engine, progress)
        return replace(self, result=replace(result, policy=self.name), file=file)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        policy, chosen = self.policy and str(self.policy), self.chosen and self.chosen.to_json()
        known = {"name": self.name, "policy": policy, "chosen": chosen}
        return known | self.test.success.to_json() | {"evaluation": str(self.file)}


@dataclass(frozen=True)
class Arm:
    """One side of a comparison: one policy, or one a training seed."""

    name: str
    members: tuple[Member, ...]

    @property
    def training_seeds(self) -> list[int | None]:
        """Training seeds, in the order of the members."""
        return [member.training_seed for member in self.members]

    @property
    def test_rate(self) -> float:
        """Mean success over training seeds."""
        return fmean(member.test.success.rate for member in self.members)

    @property
    def has_histories(self) -> bool:
        """Whether every policy comes from a run."""
        return all(member.history for member in self.members)

    def map(self, change: Callable[[Member], Member]) -> Arm:
        """Return the arm with every member changed."""
        return replace(self, members=tuple(map(change, self.members)))


def read_arm(path: Path) -> Arm:
    """Return what lies at `path`; `UsageError` in one line for what cannot be compared."""
    require_source(path)
    folders = [folder for folder in path.iterdir() if folder.is_dir()] if path.is_dir() else []
    seeds = {int(match[1]): folder for folder in folders if (match := _SEED_FOLDER.fullmatch(folder.name))}
    if not seeds:
        return Arm(str(path), (_read_member(path),))
    return Arm(str(path), tuple(_of_seed(folder, seed) for seed, folder in sorted(seeds.items())))


def require_pair(left: Arm, right: Arm) -> None:
    """Raise `UsageError` unless two arms can be compared: both or neither evaluated already, the same training seeds.

    Two single policies are a pair, whatever their seeds.
    """
    if len({member.result is None for arm in (left, right) for member in arm.members}) > 1:
        raise UsageError(f"{left.name} and {right.name}: one is evaluated already; give two eval.json, or two policies")
    ours, theirs = left.training_seeds, right.training_seeds
    if len(ours) != len(theirs) or (len(ours) > 1 and ours != theirs):
        raise UsageError(
            f"training seeds differ: {left.name} has {ours}, {right.name} {theirs}; runs are paired by seed, so both "
            "sides need the same ones"
        )


def run_member(folder: Path, training_seed: int) -> Member:
    """Return a run as a member, without its environment."""
    rounds = history(read_lines(folder / METRICS_FILE), str(folder))
    return Member(folder, training_seed, history=rounds, finished=run_finished(folder))


def run_finished(folder: Path) -> bool:
    """Return whether a run has a best policy, which a DAgger run gets at its end."""
    return (folder / "best" / "pretrained_model" / "config.json").is_file()


def common_env(members: Sequence[Member], policy_env: Callable[[Path], EnvConfig]) -> EnvConfig:
    """Return the environment that all are tested in: the runs' own, else that of the policies.

    policy_env: the environment of a policy, given its folder. Raises `MismatchError` naming the first setting in which
    two differ.
    """
    tested = [member for member in members if member.result is None]
    envs = {member.name: member.env for member in tested if member.env is not None}
    if not envs:
        envs = {one.name: policy_env(one.policy) for one in tested if one.policy is not None}
    first, *others = envs
    for other in others:
        require_same_env(first, envs[first], other, envs[other])
    return envs[first]


def require_same_env(left: str, env: EnvConfig, right: str, other: EnvConfig) -> None:
    """Raise `MismatchError` naming the first field that differs."""
    for field in fields(env):
        ours, theirs = getattr(env, field.name), getattr(other, field.name)
        if field.name == "object":
            ours, theirs = ours or OWN_OBJECT, theirs or OWN_OBJECT
        if ours != theirs:
            raise MismatchError(field.name, left, ours, right, theirs)


def _read_member(path: Path) -> Member:
    if path.is_file():
        return Member(path, result=EvalResult.read(path), file=path)
    options, records = _run_options(path), read_lines(path / METRICS_FILE)
    if options is not None or any("round" in record for record in records):  # `manip-il train` counts steps there
        rounds = history(records, str(path))
        seed, env = options or (None, None)
        return Member(path, seed, history=rounds, env=env, finished=run_finished(path))
    if (path / FILE_NAME).is_file():
        return Member(path, result=EvalResult.read(path), file=path / FILE_NAME)
    try:
        return Member(path, policy=find_policy(path))
    except UsageError:
        raise UsageError(f"{path} holds nothing to compare; {EXPECTED}") from None


def _of_seed(folder: Path, seed: int) -> Member:
    member = _read_member(folder)
    if member.training_seed not in (None, seed):
        raise MismatchError("training seed", f"the name {folder}", seed, f"its {CONFIG_FILE}", member.training_seed)
    return replace(member, training_seed=seed)


def _run_options(folder: Path) -> tuple[int, EnvConfig] | None:
    """Training seed and environment of the DAgger run in `folder`; None if there is no such run."""
    path = folder / CONFIG_FILE
    if not path.is_file() or "(DaggerOptions)" not in path.read_text(errors="replace").partition("\n")[0]:
        return None
    tree = checks.mapping(str(path), checks.read_yaml(path, "the options of a run"))
    groups: dict[str, Mapping[str, Any]] = {name: tree.get(name) or {} for name in ("robot", "task", "env")}
    own = {"robot": groups["robot"].get("type"), "task": groups["task"].get("type"), **groups["env"]}
    own["object"] = groups["task"].get("object")
    if reward := groups["task"].get("reward"):  # of carry, before it was part of the name
        own["task"] = f"{own['task']}:{reward}"
    known = {field.name for field in fields(EnvConfig)}
    env = make_config(**{name: value for name, value in own.items() if name in known and value is not None})
    return checks.whole(f"{path}: seed", tree.get("seed", 0), 0, checks.LARGEST_SEED), env


def _round_policy(folder: Path, chosen: Round) -> Path:
    """The `pretrained_model` folder of a run's round, or of an iteration that was validated."""
    if chosen.unit == "iteration":
        return find_policy(folder / "validation" / f"{chosen.round:06d}")
    return find_policy(folder / f"round_{chosen.round:03d}" / "policy")
