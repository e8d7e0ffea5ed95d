"""Policies on the same test episodes, each measured once: what is done is known by what the policy is."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.cli.suites import suite_conditions
from manip_il.data.fingerprint import canonical_json
from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.comparison import Member
from manip_il.evaluation.results import EvalResult, EvalSettings

if TYPE_CHECKING:
    from manip_il.cli.sides import Source
    from manip_il.cli.stages import Stages
    from manip_il.engine.engine import Engine
    from manip_il.engine.jobs import RolloutJob
    from manip_il.evaluation.rounds import Rule
    from manip_il.sim.conditions import Condition
    from manip_il.sim.env import EnvConfig

FOLDER = "evaluations"
TEST_EPISODES = 500


@dataclass(frozen=True)
class Trial:
    """In which environment, on which seeds and under which conditions policies are measured.

    trust: whether models that their checkpoints name may be loaded.
    """

    env: EnvConfig
    seeds: range
    suite: str = "nominal"
    conditions: tuple[Condition, ...] = ()
    trust: bool = False

    @classmethod
    def of(cls, env: EnvConfig, seeds: range, suite: str, policies: Iterable[Path], trust: bool = False) -> Trial:
        """Under a suite's conditions: those of cameras are left out where none of the policies looks at one."""
        from manip_il.engine.sight import policy_cameras

        sees = any(policy_cameras(policy) is not None for policy in policies)
        return cls(env, seeds, suite, suite_conditions(suite, env.task, sees=sees), trust)

    def job(self, policy: Path) -> RolloutJob:
        """Return the rollouts of one policy."""
        from manip_il.engine.jobs import RolloutJob
        from manip_il.evaluation.runner import HOLD

        job = RolloutJob(self.env, "policy", policy=policy, hold=HOLD, label="last", conditions=self.conditions)
        return replace(job, trust=self.trust)

    def file(self, folder: Path, policy: Path) -> Path:
        """Return where the evaluation of `policy` lies: named after its files, the environment and the episodes.

        So another policy of the same name is another file, and what was measured before stays true.
        """
        from manip_il.engine.describe import env_fingerprint, policy_sha256

        settings = EvalSettings.of(self.job(policy), self.suite).to_json()
        made_of = (env_fingerprint(self.env), self.seeds.start, len(self.seeds), settings, policy_sha256(policy))
        return folder / FOLDER / f"{hashlib.sha256(canonical_json(made_of).encode()).hexdigest()[:16]}.json"

    def check_result(self, name: str, result: EvalResult) -> None:
        """Raise `MismatchError` or `ManipError` unless an evaluation from elsewhere is this test's."""
        settings = EvalSettings.of(self.job(Path()), self.suite)
        wanted = {"robot": self.env.robot, "task": self.env.task, "settings": settings}
        for what, value in wanted.items():
            if getattr(result, what) != value:
                raise MismatchError(what, name, getattr(result, what), "this comparison", value)
        theirs = {episode.seed for episode in result.episodes}
        if theirs != set(self.seeds):
            raise ManipError(
                f"test episodes differ: {name} has {len(theirs)}, this comparison {len(self.seeds)}, of which "
                f"{len(theirs & set(self.seeds))} are the same; give its --seed and --eval.n_episodes here"
            )


def check_policies(trial: Trial, policies: dict[str, Path], folder: Path, engine: str) -> None:
    """Raise, before any episode runs, where one of the policies (name -> folder) cannot be measured by `trial`."""
    from manip_il.cli.policy_check import check_policy
    from manip_il.learn.checkpoint import read_meta

    for name, policy in policies.items():
        if not trial.file(folder, policy).is_file():
            meta = read_meta(policy)
            if meta is not None and meta.task != trial.env.task:
                raise MismatchError("task", name, meta.task, "the comparison", trial.env.task)
            check_policy(policy, meta, trial.env, draw=engine == "local", trust=trial.trust)


def measure(
    trial: Trial, policy: Path, name: str, folder: Path, engine: Engine, stages: Stages
) -> tuple[EvalResult, Path]:
    """Return the evaluation of one policy and its file: read where it is there, else made."""
    from manip_il.evaluation.runner import evaluate

    file = trial.file(folder, policy)
    if not file.is_file():
        stages.start(f"test {name}", len(trial.seeds))
        result = evaluate(engine, trial.job(policy), trial.seeds, name, stages.episode, suite=trial.suite)
        stages.close()
        if len(result.episodes) < len(trial.seeds):
            raise ManipError(
                f"{name} has {len(result.episodes)} of {len(trial.seeds)} test episodes, because workers died"
            )
        result.write(file)
    return replace(EvalResult.read(file), policy=name), file


def measured(
    source: Source, rule: Rule, limit: float | None, trial: Trial, folder: Path, engine: Engine, stages: Stages
) -> Member:
    """Return the policy that `rule` takes of `source`, with its evaluation."""
    policy, chosen = source.chosen(rule, limit)
    result, file = measure(trial, policy, source.name, folder, engine, stages)
    return Member(source.name, result, file, source.training_seed, policy, chosen, source.history)


def rule_json(rule: Rule, limit: float | None) -> dict[str, Any]:
    """Return the rule as `compare.json` and `study.json` hold it."""
    return {"checkpoint": rule.checkpoint, "at": str(rule), "limit": limit}
