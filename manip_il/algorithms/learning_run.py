"""The steps that GAIL, AIRL and PPO are made of: environments, learner, and what is kept of every iteration.

checkpoints/last/    the last finished iteration: its policy, and all that the next one needs
validation/          by iteration, every validated policy and its eval.json
best/                the policy with the highest validation success, the later of equals

An iteration is whole episodes from seeds of its own, and draws from random streams of its own: a run that was killed
goes on from its last finished iteration to the same bytes.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, override

import numpy as np

from manip_il.algorithms.learning_config import LONGER, LearningConfig
from manip_il.algorithms.run import Result, Run, Watch
from manip_il.algorithms.vector_env import ActionRange, Lockstep, RobotEpisode
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.atomic import new_folder
from manip_il.data.dataset import Dataset
from manip_il.errors import UsageError
from manip_il.evaluation.eval_report import run_report
from manip_il.evaluation.figures import CLONING, DAGGER, Curve
from manip_il.evaluation.report import Report
from manip_il.evaluation.results import FILE_NAME, EvalResult, compare_results
from manip_il.evaluation.rounds import history
from manip_il.evaluation.runner import HOLD
from manip_il.evaluation.tables import PolicyRow
from manip_il.learn.checkpoint import Origin, in_one_line
from manip_il.learn.discriminators import Discriminator
from manip_il.learn.network import MLPNetwork, threads
from manip_il.learn.ppo import Learner, lent_generators
from manip_il.learn.start import save_policy, start_conversion, start_policy
from manip_il.learn.training_state import (
    PRETRAINED_MODEL,
    TRAINING_STATE,
    last_checkpoint,
    new_checkpoint,
    read_step,
    write_own_files,
)
from manip_il.learn.transitions import Transitions, read_demonstrations
from manip_il.mdp import F32
from manip_il.seeding import rng_for, stream_base, stream_seeds

Kept = TypeVar("Kept", bound=Discriminator)
VALIDATION = "validation"


class LearningRun(Run):
    """The steps of one run in `folder`. Raises what `start_conversion` and `read_demonstrations` raise.

    Also `UsageError` for options that do not fit those.
    """

    config: LearningConfig

    def __init__(self, config: LearningConfig, folder: Path, engine: Engine, watch: Watch | None = None):
        super().__init__(config, folder, engine, watch)
        self._modules: dict[str, Discriminator] = {}
        self._number, self._simulated, self._validated_at = 0, 0, 0
        self._metrics: dict[str, float] = {}
        self._spec = spec = Dataset.open(config.datasets[0]).spec if config.datasets else env_spec(config.env)
        self.conversion = start_conversion(config.start, config.action_space, spec)
        demonstrations = read_demonstrations(config.datasets, self.conversion.encode) if config.datasets else None
        self.horizon = config.episode_steps or config.env.horizon
        if demonstrations and not config.episode_steps:
            self.horizon = min(self.horizon, math.ceil(LONGER * demonstrations.longest))
        hold = demonstrations.hold if demonstrations else None
        with threads(1), lent_generators(self._stream(0, "weights")):
            rows = demonstrations.stacked if demonstrations else None
            self._policy = start_policy(config.start, self.conversion.space, spec, rows)
            actions = ActionRange.of(self._policy.model)
            episodes = [RobotEpisode(config.env, hold) for _ in range(config.episodes)]
            self.envs = Lockstep(episodes, actions, self.horizon, self.conversion)
            clone, log_std = config.start is not None, config.first_log_std
            self._learner = Learner(self._policy.model, config.ppo, self.envs, self.horizon, log_std, clone=clone)
        self._expert = demonstrations.padded(self.horizon, actions.normalised) if demonstrations else None

    def keep(self, make: Callable[[MLPNetwork], Kept]) -> Kept:
        """Return a discriminator that belongs to the run and is saved with it. make: of the actor's network."""
        with lent_generators(self._stream(0, "discriminator")):
            self._modules["discriminator"] = made = make(self._policy.model)
        return made

    @override
    def follow(self, results: Iterator[Result]) -> Iterator[Result]:
        """Yield what the run goes on from, its last finished iteration or the policy it begins with, and what follows.

        So the line of an iteration is not lost that ended before it was written.
        """
        checkpoint = last_checkpoint(self.folder, resume=True)
        if checkpoint is not None:
            step, policy = read_step(checkpoint), checkpoint / PRETRAINED_MODEL
            with in_one_line(f"{checkpoint} cannot be resumed"):
                self._number, self._simulated = int(step["step"]), int(step["simulated"])
                self._metrics, self._validated_at = dict(step["metrics"]), int(step["validated_at"])
            yield self._result(policy, self._validate_if_due(policy))
        elif self.config.start is not None:
            yield self._result(self.config.start, self._validate_kept(self.config.start))
        yield from results

    def iterations(self) -> Iterator[int]:
        """Yield the numbers, from 1 or from the last finished iteration's on, until all steps are simulated."""
        if checkpoint := last_checkpoint(self.folder, resume=True):
            with in_one_line(f"{checkpoint} cannot be resumed"), threads(1):
                self._learner.load(checkpoint / TRAINING_STATE, self._modules)
        while self._simulated < self.config.steps:
            self._number += 1
            self._metrics = {}
            yield self._number

    def rollouts(self, number: int) -> Transitions:
        """Run the learner's episodes of an iteration; return all steps, those of absorbing states too."""
        self._number = number
        self.envs.seed(
            stream_seeds("reinforcement", number * self.config.episodes, self.config.seed)[-self.config.episodes]
        )
        with self._timed("collect"), threads(1), lent_generators(self._stream(number, "rollouts")):
            self._rows = self._learner.collect()
        self._simulated += self.envs.simulated
        self._metrics["success"] = float(self.envs.solved.mean())
        self._metrics["absorbing"] = float(self._rows.absorbing.mean())
        return self._rows

    def executed(self) -> tuple[F32, F32, F32]:
        """Return joint states (N, n), environment states (N, k) and absolute actions (N, n) of the last rollouts."""
        n = len(self._spec.joint_names)
        states = self._rows.states[:, :-1]
        return states[:, :n], states[:, n:], np.concatenate(self.envs.executed).astype(np.float32)

    def log_prob(self, rows: Transitions) -> F32:
        """Return rows' log-densities for the learner above their mean [nats], (N,); see `Learner.log_prob`."""
        with threads(1):
            return self._learner.log_prob(rows)

    def discriminate(self, d: Discriminator, learner: Transitions) -> None:
        """Fit a discriminator to the demonstrations and the learner's steps.

        The demonstrated actions get noise as wide as the learner's first spread: it is then known by where it aims.
        Without it, it is known by its exploration, which tells it nothing and makes the densities of AIRL meaningless.
        """
        if self._expert is None:
            raise UsageError("no demonstrations to tell the learner from; give --dataset.root=DIR")
        rng = rng_for(self._stream(self._number, "discriminator"), "batches")
        with self._timed("fit"), threads(1):
            expert = self._learner.explored(self._expert, rng)
            density = self._learner.log_prob
            log_probs = (density(expert), density(learner)) if d.asks_density else None
            found = d.fit(expert, learner, log_probs, rng)
        self._metrics |= {f"discriminator_{name}": value for name, value in found.items()}

    def improve(self, rewards: F32) -> None:
        """Let PPO learn from the rewards (N,) of the last rollouts."""
        self._metrics["return"] = float(rewards.sum() / self.config.episodes)
        remaining = max(0.0, 1.0 - self._simulated / self.config.steps)
        moves = self._number > self.config.warmup_iterations
        with self._timed("fit"), threads(1), lent_generators(self._stream(self._number, "updates")):
            self._metrics |= self._learner.improve(rewards, actor=moves, remaining=remaining)

    def finish(self) -> Result:
        """Write the iteration, which ends it; validate its policy where that is due."""
        config = self.config
        fingerprint, space = env_fingerprint(config.env), self.conversion.space
        origin = Origin.of(self._spec, fingerprint, self._options(), action_space=space)
        step = {"step": self._number, "simulated": self._simulated, "metrics": self._metrics}
        with new_checkpoint(self.folder / "checkpoints" / f"{self._number:06d}") as new:
            save_policy(self._policy, self.conversion, new / PRETRAINED_MODEL)
            (new / TRAINING_STATE).mkdir()
            self._learner.save(new / TRAINING_STATE, self._modules)
            write_own_files(new, origin, step | {"validated_at": self._validated_at})
        for other in (self.folder / "checkpoints").iterdir():
            if not other.is_symlink() and other.name != f"{self._number:06d}":
                shutil.rmtree(other, ignore_errors=True)
        self._watch.on_step()
        policy = self.folder / "checkpoints" / "last" / PRETRAINED_MODEL
        return self._result(policy, self._validate_if_due(policy))

    def _result(self, policy: Path, validated: EvalResult | None) -> Result:
        episodes, seconds = self._number * self.config.episodes, self._take_seconds()
        return Result("iteration", self._number, self._simulated, episodes, self._metrics, policy, validated, seconds)

    def _validate_if_due(self, policy: Path) -> EvalResult | None:
        every = self.config.validation_every
        if self._simulated < self.config.steps and self._simulated // every == self._validated_at // every:
            return None
        self._validated_at = self._simulated
        return self._validate_kept(policy)

    def _validate_kept(self, policy: Path) -> EvalResult:
        """Evaluate a policy, of which the run keeps a copy, unless that has been done; keep it if it is the best."""
        number = self._number
        here = self.folder / VALIDATION / f"{number:06d}"
        if not here.is_dir():
            with new_folder(here) as new:
                shutil.copytree(policy, new / PRETRAINED_MODEL)
        job = RolloutJob(self.config.env, PolicyDriver((policy,)), HOLD, label="last")
        found = self._validate(job, here / FILE_NAME, f"iteration {number}")
        if number == best_validation(validations(self.folder)):
            self._keep_best(policy)
        return found

    def _options(self) -> dict[str, Any]:
        """The options that a checkpoint names."""
        left_out = ("method", "env", "datasets", "start", "reward")
        kept = {name: value for name, value in asdict(self.config).items() if name not in left_out}
        names = [root.resolve().name for root in self.config.datasets]
        start = self.config.start
        return kept | {"datasets": names, "init": None if start is None else start.resolve().name}

    def _stream(self, number: int, purpose: str) -> int:
        """A seed for one purpose of an iteration."""
        base = stream_base("reinforcement", self.config.seed)
        return int(rng_for(base + number, purpose).integers(2**63))


def validations(folder: Path) -> dict[int, EvalResult]:
    """Return a run's validations by iteration, in order."""
    return {int(path.parent.name): EvalResult.read(path) for path in sorted(folder.glob(f"{VALIDATION}/*/{FILE_NAME}"))}


def best_validation(found: dict[int, EvalResult]) -> int:
    """Return the iteration with the highest validation success, the later of equals."""
    return max(found, key=lambda number: (found[number].success.rate, number))


def learning_report(
    title: str,
    found: dict[int, EvalResult],
    records: Sequence[Mapping[str, Any]],
    command: str,
    config: Mapping[str, Any],
) -> Report:
    """Return the report of a run. found: its validations by iteration, not none. records: lines of metrics.jsonl."""
    best, names = best_validation(found), {number: f"iteration {number}" for number in found} | {0: "policy given"}
    facts = ["The best policy was chosen on these episodes, so they flatter it; measure it by manip-il eval."]
    if 0 in found and best:
        facts.insert(0, compare_results(found[0], found[best], (names[0], names[best])).verdict)
    return run_report(
        [
            PolicyRow(names[number], found[number], colour=DAGGER if number else CLONING)
            for number in sorted({min(found), best, max(found)})
        ],
        curves=[Curve(title, (history(records, title),), costs=("steps", "seconds"))],
        title=title,
        verdict=f"Best {names[best]}: validation success {found[best].success}.",
        facts=tuple(facts),
        command=command,
        config=config,
        fingerprint=found[best].fingerprint,
    )
