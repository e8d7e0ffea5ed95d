"""Candidates of a comparison: an evaluation, a policy, a DAgger run, or a folder of these by training seed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.cli.common_options import EnvGroup, MaybeTaskGroup
from manip_il.cli.dagger import METRICS_FILE, DaggerOptions
from manip_il.cli.inputs import find_policy, hub_hint
from manip_il.cli.outputs import CONFIG_FILE, read_jsonl
from manip_il.cli.parsing import from_yaml
from manip_il.cli.progress import Stages
from manip_il.cli.trials import Trial
from manip_il.data.schema import OWN_OBJECT
from manip_il.errors import MismatchError, UsageError
from manip_il.evaluation.comparison import Member
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.evaluation.rounds import END, History, Round, Rule, budget, history, select_round

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine
    from manip_il.sim.config import EnvConfig

_SEED_FOLDER = re.compile(r"seed_(\d+)")
_EXPECTED = "expected an eval.json, a policy, a run of manip-il dagger, or a folder of seed_0, seed_1, ... of these"


@dataclass(frozen=True)
class Source:
    """One policy to compare, or an evaluation or a run of one.

    training_seed: None where nothing says it. result: of an evaluation that is taken as it is. policy: a policy that
    is no run's. history, env, finished: of a run; env is None where its options are not beside it.
    """

    path: Path
    training_seed: int | None = None
    result: EvalResult | None = None
    policy: Path | None = None
    history: History = ()
    env: EnvConfig | None = None
    finished: bool = True

    @property
    def name(self) -> str:
        """Path, for tables and errors."""
        return str(self.path)

    def select(self, rule: Rule, limit: float | None) -> tuple[Path, Round | None]:
        """Return the policy's folder, and the round that `rule` selects of a run; `UsageError` where there is none."""
        if self.policy is not None:
            return self.policy, None
        round_ = select_round(rule, self.history, limit, self.name)
        return round_policy(self.path, round_), round_

    def measure(
        self, rule: Rule, limit: float | None, trial: Trial | None, folder: Path, engine: Engine, stages: Stages
    ) -> Member:
        """Return the evaluation itself, or that of the policy that `rule` selects, which is stored in `folder`."""
        if self.result is not None or trial is None:
            return Member(self.name, self.evaluation, self.path, self.training_seed)
        policy, round_ = self.select(rule, limit)
        file = trial.file(folder, policy)
        result = replace(trial.measure(policy, self.name, file, engine, stages), policy=self.name)
        return Member(self.name, result, file, self.training_seed, policy, round_, self.history)

    @property
    def evaluation(self) -> EvalResult:
        """The evaluation, of a source that is one."""
        assert self.result is not None
        return self.result


@dataclass(frozen=True)
class Candidate:
    """LEFT or RIGHT: one source, or one for each training seed (`several`)."""

    path: Path
    sources: tuple[Source, ...]
    several: bool = False


def require_candidate(path: Path) -> None:
    """Raise `UsageError` where nothing is at `path`."""
    if not path.exists():
        raise UsageError(f"{path} does not exist; {_EXPECTED}{hub_hint(path)}")


def read_candidate(path: Path) -> Candidate:
    """Return what lies at `path`; `UsageError` in one line where it is nothing that can be compared."""
    require_candidate(path)
    folders = [folder for folder in path.iterdir() if folder.is_dir()] if path.is_dir() else []
    seeds = {int(match[1]): folder for folder in folders if (match := _SEED_FOLDER.fullmatch(folder.name))}
    if not seeds:
        return Candidate(path, (_read_source(path),))
    return Candidate(path, tuple(_of_seed(folder, seed) for seed, folder in sorted(seeds.items())), several=True)


def match_seeds(left: Candidate, right: Candidate) -> tuple[Candidate, Candidate, list[str]]:
    """Return both sides with the training seeds that both have, and a line for each side that loses some.

    Raises `UsageError` where a single policy meets several training seeds, or none is shared.
    """
    if not left.several and not right.several:
        return left, right, []
    if left.several != right.several:
        one, many = (right, left) if left.several else (left, right)
        raise UsageError(
            f"{one.path} is one policy, {many.path} holds {len(many.sources)} training seeds; compare two folders of "
            f"seeds, or one of the runs in it, such as {many.sources[0].path}"
        )
    ours, theirs = ({source.training_seed for source in side.sources} for side in (left, right))
    shared = ours & theirs
    if not shared:
        raise UsageError(
            f"no training seed is shared: {left.path} has {_numbers(ours)}, {right.path} {_numbers(theirs)}; runs are "
            "paired by seed"
        )
    lines = [
        f"{side.path}: training seeds {_numbers(seeds - shared)} have no partner and are left out"
        for side, seeds in ((left, ours), (right, theirs))
        if seeds - shared
    ]
    return _with_seeds(left, shared), _with_seeds(right, shared), lines


def limit_of(rule: Rule, sources: Iterable[Source]) -> float | None:
    """Return the amount of `rule.axis` that all runs may have used; `UsageError` where a source has no rounds."""
    sources = list(sources)
    for source in sources:
        if rule.axis != END and not source.history:
            what = "an evaluation" if source.result is not None else "a policy"
            raise UsageError(f"--at={rule}: {source.name} is {what} and has no rounds; give a run of manip-il dagger")
    return budget(rule, [source.history for source in sources])


def common_env(sources: Sequence[Source], group: EnvGroup, robot: str | None, task: MaybeTaskGroup) -> EnvConfig:
    """Return the environment that all are tested in: the runs' own, else `--env.*` with the policies' robot and task.

    Raises `MismatchError` naming the first setting in which two differ.
    """
    run = next((source.env for source in sources if source.env is not None), None)
    tested = [source for source in sources if source.result is None]
    envs = [source.env or _policy_env(source, run, group, robot, task) for source in tested]
    for source, env in zip(tested, envs, strict=True):
        require_same_env(tested[0].name, envs[0], source.name, env)
    return envs[0]


def require_same_env(left: str, env: EnvConfig, right: str, other: EnvConfig) -> None:
    """Raise `MismatchError` naming the first field that differs."""
    for field in fields(env):
        ours, theirs = getattr(env, field.name), getattr(other, field.name)
        if field.name == "object":
            ours, theirs = ours or OWN_OBJECT, theirs or OWN_OBJECT
        if ours != theirs:
            raise MismatchError(field.name, left, ours, right, theirs)


def run_history(folder: Path) -> History:
    """Return the rounds of a run so far."""
    return history(read_jsonl(folder / METRICS_FILE), str(folder))


def round_policy(folder: Path, round_: Round) -> Path:
    """Return the `pretrained_model` folder of a run's round, or of an iteration that was validated."""
    if round_.unit == "iteration":
        from manip_il.algorithms.iterations import validated
        from manip_il.learn.training_state import PRETRAINED_MODEL

        return find_policy(validated(folder, round_.round) / PRETRAINED_MODEL)
    from manip_il.algorithms.run import round_folder

    return find_policy(round_folder(folder, round_.round) / "policy")


def run_finished(folder: Path) -> bool:
    """Return whether a run has a best policy, which a DAgger run gets at its end."""
    return (folder / "best" / "pretrained_model" / "config.json").is_file()


def _read_source(path: Path) -> Source:
    if path.is_file():
        return Source(path, result=EvalResult.read(path))
    options = _run_options(path)
    records = read_jsonl(path / METRICS_FILE) if (path / METRICS_FILE).is_file() else []
    if options is not None or any("round" in record for record in records):  # `manip-il train` counts steps there
        source = Source(path, history=history(records, str(path)), finished=run_finished(path))
        return source if options is None else replace(source, training_seed=options.seed, env=options.env_config())
    if (path / FILE_NAME).is_file():
        return Source(path, result=EvalResult.read(path))
    try:
        return Source(path, policy=find_policy(path))
    except UsageError:
        raise UsageError(f"{path} holds nothing to compare; {_EXPECTED}") from None


def _of_seed(folder: Path, seed: int) -> Source:
    source = _read_source(folder)
    if source.training_seed not in (None, seed):
        raise MismatchError("training seed", f"the name {folder}", seed, f"its {CONFIG_FILE}", source.training_seed)
    return replace(source, training_seed=seed)


def _run_options(folder: Path) -> DaggerOptions | None:
    """Return the options of the DAgger run in `folder`; None where there is no such run."""
    path = folder / CONFIG_FILE
    if not path.is_file() or f"({DaggerOptions.__name__})" not in path.read_text(errors="replace").partition("\n")[0]:
        return None
    return from_yaml(path, DaggerOptions)


def _policy_env(
    source: Source, run: EnvConfig | None, group: EnvGroup, robot: str | None, task: MaybeTaskGroup
) -> EnvConfig:
    """Return the environment of a policy, whose checkpoint holds robot, task and rate, but no tolerance or horizon."""
    from manip_il.learn.checkpoint import read_origin

    meta = read_origin(source.policy or round_policy(source.path, source.history[0]))
    if run is not None:
        own = {} if meta is None else {"robot": meta.robot, "task": meta.task, "object": meta.object}
        return run if meta is None else replace(run, control_hz=meta.fps, **own)
    return group.config(robot, task.type, meta, task.object, task.reward)


def _with_seeds(candidate: Candidate, seeds: set[int | None]) -> Candidate:
    return replace(candidate, sources=tuple(source for source in candidate.sources if source.training_seed in seeds))


def _numbers(seeds: Iterable[int | None]) -> str:
    return ", ".join(str(seed) for seed in sorted(seed for seed in seeds if seed is not None))
