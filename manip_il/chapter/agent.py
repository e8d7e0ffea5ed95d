"""The learner of GAIL, AIRL and PPO: an mlp with its own environments, improved by rewards that the algorithm gives it.

Each iteration runs whole episodes, with its own seeds and random streams, so a killed run that is resumed from its
last finished iteration ends with the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.algorithms.results import Stopwatch
from manip_il.chapter.actor_critic import Learner, save_policy, seed_generators, start_conversion, start_policy
from manip_il.chapter.discriminators import Discriminator
from manip_il.chapter.learning_config import LONGER, LearningConfig
from manip_il.chapter.transitions import Transitions, read_demonstrations
from manip_il.chapter.vector_env import ActionRange, Lockstep, RobotEpisode
from manip_il.data.dataset import Dataset
from manip_il.errors import UsageError
from manip_il.learn.checkpoint import Origin, in_one_line
from manip_il.learn.network import MLPNetwork, threads
from manip_il.learn.training_state import PRETRAINED_MODEL, TRAINING_STATE, new_checkpoint, read_step, write_own_files
from manip_il.mdp import F32
from manip_il.seeding import rng_for, stream_base, stream_seeds
from manip_il.worlds.table import env_fingerprint, env_spec


class Agent:
    """A policy, its environments, and the demonstrations that it imitates, if any.

    number, simulated: iterations and control steps so far; metrics: of the last iteration. validated_at: control
    steps at the last validation. Raises what `start_conversion` and `read_demonstrations` raise, and `UsageError` for
    options that do not fit the demonstrations.
    """

    def __init__(self, config: LearningConfig, clock: Stopwatch):
        self.config, self._clock = config, clock
        self.number = 0
        self.simulated = 0
        self.validated_at = 0
        self.metrics: dict[str, float] = {}
        self._modules: dict[str, Discriminator] = {}
        self._spec = spec = Dataset.open(config.datasets[0]).spec if config.datasets else env_spec(config.env)
        self._conversion = start_conversion(config.start, config.action_space, spec)
        demonstrations = read_demonstrations(config.datasets, self._conversion.encode) if config.datasets else None
        horizon = config.episode_steps or config.env.horizon
        if demonstrations and not config.episode_steps:
            horizon = min(horizon, math.ceil(LONGER * demonstrations.longest))
        hold = demonstrations.hold if demonstrations else None
        with threads(1):
            seed_generators(self._stream("weights"))
            rows = demonstrations.stacked if demonstrations else None
            self._policy = start_policy(config.start, self._conversion, spec, rows)
            actions = ActionRange.of(self._policy.model)
            episodes = [RobotEpisode(config.env, hold) for _ in range(config.episodes)]
            self.envs = Lockstep(episodes, actions, horizon, self._conversion)
            clone, log_std = config.start is not None, config.first_log_std
            self._learner = Learner(self._policy.model, config.ppo, self.envs, horizon, log_std, clone=clone)
        self._expert = demonstrations.padded(horizon, actions.normalised) if demonstrations else None

    def keep(self, make: Callable[[MLPNetwork], Discriminator]) -> Discriminator:
        """Return the discriminator that `make` builds from the actor's network; it is saved with the agent."""
        seed_generators(self._stream("discriminator"))
        self._modules["discriminator"] = made = make(self._policy.model)
        return made

    def rollouts(self) -> Transitions:
        """Start an iteration by running its episodes; return all steps, including those in absorbing states."""
        config = self.config
        self.number += 1
        self.envs.seed(stream_seeds("reinforcement", self.number * config.episodes, config.seed)[-config.episodes])
        with self._clock.timed("collect"), threads(1):
            seed_generators(self._stream("rollouts"))
            self._rows = self._learner.collect()
        self.simulated += self.envs.simulated
        solved, absorbing = self.envs.solved.mean(), self._rows.absorbing.mean()
        self.metrics = {"success": float(solved), "absorbing": float(absorbing)}
        return self._rows

    def executed(self) -> tuple[F32, F32, F32]:
        """Return joint states (N, n), environment states (N, k) and absolute actions (N, n) of the last rollouts."""
        n = len(self._spec.joint_names)
        states = self._rows.states[:, :-1]
        return states[:, :n], states[:, n:], np.concatenate(self.envs.executed).astype(np.float32)

    def log_prob(self, rows: Transitions) -> F32:
        """Return log-density plus entropy [nats] of each row's action, (N,); see `Learner.log_prob`."""
        with threads(1):
            return self._learner.log_prob(rows)

    def discriminate(self, d: Discriminator, steps: Transitions) -> None:
        """Fit a discriminator to the demonstrations and the agent's steps.

        The demonstrated actions get noise with the learner's initial standard deviation. Without this noise the
        discriminator would only detect the learner's exploration noise, and AIRL's densities would be meaningless.
        """
        if self._expert is None:
            raise UsageError("no demonstrations to compare the learner with; give --dataset.root=DIR")
        rng = rng_for(self._stream("discriminator"), "batches")
        with self._clock.timed("fit"), threads(1):
            expert = self._learner.explored(self._expert, rng)
            density = self._learner.log_prob
            log_probs = (density(expert), density(steps)) if d.asks_density else None
            found = d.fit(expert, steps, log_probs, rng)
        self.metrics |= {f"discriminator_{name}": value for name, value in found.items()}

    def improve(self, rewards: F32) -> None:
        """Update the policy by PPO with the rewards (N,) of the last rollouts."""
        self.metrics["return"] = float(rewards.sum() / self.config.episodes)
        remaining = max(0.0, 1.0 - self.simulated / self.config.steps)
        warm = self.number > self.config.warmup_iterations
        with self._clock.timed("fit"), threads(1):
            seed_generators(self._stream("updates"))
            self.metrics |= self._learner.improve(rewards, actor=warm, remaining=remaining)

    def save(self, folder: Path) -> None:
        """Write a checkpoint of the iteration: its policy, and everything that the next iteration needs."""
        fingerprint, space = env_fingerprint(self.config.env), self._conversion.space
        origin = Origin.of(self._spec, fingerprint, self._options(), action_space=space)
        step = {"step": self.number, "simulated": self.simulated, "metrics": self.metrics}
        with new_checkpoint(folder) as new:
            save_policy(self._policy, self._conversion, new / PRETRAINED_MODEL)
            (new / TRAINING_STATE).mkdir()
            self._learner.save(new / TRAINING_STATE, self._modules)
            write_own_files(new, origin, step | {"validated_at": self.validated_at})

    def load(self, folder: Path) -> None:
        """Load a checkpoint to continue from. Raises `ManipError` if it is incomplete."""
        step = read_step(folder)
        with in_one_line(f"{folder} cannot be resumed"), threads(1):
            self.number, self.simulated = int(step["step"]), int(step["simulated"])
            self.metrics, self.validated_at = dict(step["metrics"]), int(step["validated_at"])
            self._learner.load(folder / TRAINING_STATE, self._modules)

    def _options(self) -> dict[str, Any]:
        """The options that are stored in a checkpoint."""
        omitted = ("method", "env", "datasets", "start", "reward")
        kept = {name: value for name, value in asdict(self.config).items() if name not in omitted}
        names = [root.resolve().name for root in self.config.datasets]
        start = self.config.start
        return kept | {"datasets": names, "init": None if start is None else start.resolve().name}

    def _stream(self, purpose: str) -> int:
        """The seed for one purpose in the current iteration."""
        base = stream_base("reinforcement", self.config.seed)
        return int(rng_for(base + self.number, purpose).integers(2**63))
