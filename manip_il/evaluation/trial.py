"""A test that several policies take on the same seeds: each result is stored, and read again if it is there."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from manip_il.collect.drivers import ExpertDriver, PolicyDriver
from manip_il.collect.environments import env_fingerprint
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.fingerprint import canonical_json
from manip_il.errors import ManipError
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.runner import episode_hold, evaluate
from manip_il.evaluation.suites import suite_conditions
from manip_il.learn.policy_files import policy_cameras, policy_sha256
from manip_il.mdp import Episode
from manip_il.sim.conditions import Condition
from manip_il.sim.config import EnvConfig

FOLDER = "evaluations"


class Progress(Protocol):
    """Interface of what shows work under way, a stage at a time."""

    def start(self, description: str, total: int) -> None:
        """Begin a stage of so many episodes or steps."""
        ...

    def episode(self, episode: Episode | EpisodeResult) -> None:
        """Count an episode."""
        ...

    def step(self) -> None:
        """Count a step."""
        ...

    def log(self, record: dict[str, Any]) -> None:
        """Take a fit's metrics at a step."""
        ...

    def close(self) -> None:
        """End the stage."""
        ...


@dataclass(frozen=True)
class Trial:
    """Environment, seeds and conditions of a test; trust: whether models that checkpoints name may be loaded."""

    env: EnvConfig
    seeds: range
    suite: str = "nominal"
    conditions: tuple[Condition, ...] = ()
    trust: bool = False

    @classmethod
    def of(cls, env: EnvConfig, seeds: range, suite: str, policies: Iterable[Path] = (), trust: bool = False) -> Trial:
        """Make one of a suite's conditions, without those of cameras if none of the policies uses any."""
        sees = any(policy_cameras(policy) is not None for policy in policies)
        return cls(env, seeds, suite, suite_conditions(suite, env, sees=sees), trust)

    def job(self, policy: Path | None) -> RolloutJob:
        """Return the rollouts of one policy; None: of the expert."""
        driver = ExpertDriver() if policy is None else PolicyDriver((policy,), trust=self.trust)
        return RolloutJob(self.env, driver, episode_hold(self.env), label="last", conditions=self.conditions)

    def file(self, folder: Path, policy: Path | None) -> Path:
        """Return the file of a policy's or the expert's evaluation, named after its files, environment and episodes.

        So another policy of the same name is another file, and what was measured before stays true.
        """
        settings = EvalSettings.of(self.job(policy), self.suite).to_json()
        made_of = (
            env_fingerprint(self.env),
            self.seeds.start,
            len(self.seeds),
            settings,
            policy and policy_sha256(policy),
        )
        return folder / FOLDER / f"{hashlib.sha256(canonical_json(made_of).encode()).hexdigest()[:16]}.json"

    def measure(
        self,
        policy: Path | None,
        name: str,
        file: Path,
        engine: Engine,
        progress: Progress,
        *,
        complete: bool = True,
    ) -> EvalResult:
        """Return the evaluation of a policy from its file, which is made first if it is not there.

        name: in progress and results. complete: raise `ManipError` if workers died of a seed, which leaves it out.
        """
        if not file.is_file():
            progress.start(f"test {name}{'' if self.suite == 'nominal' else ', ' + self.suite}", len(self.seeds))
            result = evaluate(engine, self.job(policy), self.seeds, name, progress.episode, suite=self.suite)
            progress.close()
            if complete and len(result.episodes) < len(self.seeds):
                have = f"{len(result.episodes)} of {len(self.seeds)}"
                raise ManipError(f"{name} has {have} test episodes, because workers died")
            result.write(file)
        return EvalResult.read(file)
