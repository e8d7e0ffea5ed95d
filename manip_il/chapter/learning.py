"""Learning by reinforcement in simulation: GAIL, AIRL and PPO, as loops over a run, and the agent
that they improve.

Each iteration runs whole episodes, with its own seeds and random streams.

    validation/          every validated policy and its eval.json, by iteration
    metrics.jsonl        a line per iteration
    best/                the policy with the highest validation success; on a tie the latest
    reward/              AIRL's reward after the last iteration, if of the state alone
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, override

import numpy as np

from manip_il.algorithms.results import VALIDATION, Result, Stopwatch, best_validation, validations
from manip_il.algorithms.run import Run
from manip_il.chapter.config import LONGER, LearningConfig
from manip_il.chapter.discriminators import Discriminator
from manip_il.chapter.episodes import (
    Lockstep,
    RobotEpisode,
    read_demonstrations,
)
from manip_il.chapter.ppo import (
    Learner,
    save_policy,
    seed_generators,
    start_conversion,
    start_policy,
)
from manip_il.chapter.reward import LearnedReward, write_reward
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import HOLD, RolloutJob
from manip_il.data.atomic import new_folder
from manip_il.errors import FolderExistsError, UsageError
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.evaluation.side import METRICS_FILE
from manip_il.learn.checkpoint import Checkpoint, Origin
from manip_il.learn.network import threads
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.mdp import F32
from manip_il.seeding import rng_for, stream_base, stream_seeds
from manip_il.worlds.table import env_fingerprint, env_spec


def imitate(run: LearningRun, c: LearningConfig) -> Iterator[Result]:
    """Roll out the agent, fit the discriminator, and use its reward to improve the agent, again
    and again.

    This is generative adversarial imitation learning (Ho & Ermon, NeurIPS 2016, algorithm 1) or
    adversarial inverse reinforcement learning (Fu, Luo & Levine, ICLR 2018, algorithm 1), by the
    form of the run's discriminator, with PPO as its policy step.

    Args:
        run: The run, which makes the agent and validates it.
        c: Options of the run.

    Yields:
        The result of each iteration.
    """
    agent = run.agent()
    d = agent.discriminator()
    yield from run.begin(agent)
    while agent.simulated < c.steps:
        agent.rollouts()
        agent.improve(agent.discriminate(d))
        yield run.finish(agent)
    if c.discriminator.state_only:
        with new_folder(run.folder / "reward") as new:
            agent.save_reward(d, new / PRETRAINED_MODEL)


def ppo(
    run: LearningRun, c: LearningConfig, reward: Callable[[F32], F32] | None = None
) -> Iterator[Result]:
    """Roll out the agent and improve it with a given reward, again and again.

    The method is PPO (Schulman et al. 2017).

    Args:
        run: The run, which makes the agent and validates it.
        c: Options of the run.
        reward: Maps rows of joint state, environment state and absolute action, (N, n + k + n), to
            rewards (N,); by default the reward in the folder `c.reward`.

    Yields:
        The result of each iteration.
    """
    reward = reward or LearnedReward.load(c.reward or Path())
    agent = run.agent()
    yield from run.begin(agent)
    while agent.simulated < c.steps:
        agent.rollouts()
        agent.improve(reward(agent.executed()))
        yield run.finish(agent)


METHODS = {"gail": imitate, "airl": imitate, "ppo": ppo}


class LearningRun(Run):
    """One run of GAIL, AIRL or PPO in a folder that holds no other run.

    Attributes:
        config: A `LearningConfig`.
    """

    _validated_at = 0  # control steps at the last validation
    _policy = Path()  # the policy that was validated last

    @override
    def results(self) -> Iterator[Result]:
        """Run the loop of `config.method`, and yield its results.

        The policy of a result is the one that was validated last.

        Raises:
            FolderExistsError: If the folder holds a run.
        """
        if (self.folder / METRICS_FILE).exists():
            raise FolderExistsError(self.folder)
        return self.follow(METHODS[self.config.method](self, self.config))

    def agent(self) -> Agent:
        """Return a new agent for reinforcement learning."""
        return Agent(self.config, self._clock)

    def begin(self, agent: Agent) -> Iterator[Result]:
        """Yield the result of the initial clone, if there is one."""
        if self.config.start is not None:
            yield self.finish(agent)

    def finish(self, agent: Agent) -> Result:
        """Return the result of a finished iteration, validated if validation is due.

        Iteration 0 is always validated.
        """
        every, validated = self.config.validation_every, None
        due = agent.simulated // every != self._validated_at // every
        if due or agent.simulated >= self.config.steps or agent.number == 0:
            self._validated_at = agent.simulated
            validated = self._validate(agent)
        self._progress.step()
        return Result(
            unit="iteration",
            number=agent.number,
            steps=agent.simulated,
            episodes=agent.number * self.config.episodes,
            metrics=agent.metrics,
            policy=self._policy,
            validated=validated,
            seconds=self._clock.take(),
        )

    def _validate(self, agent: Agent) -> EvalResult:
        """Save the policy in the run and evaluate it; copy it to `best` if it is the best."""
        here = self.folder / VALIDATION / f"{agent.number:06d}"
        self._policy = here / PRETRAINED_MODEL
        with new_folder(here) as new:
            agent.save(new / PRETRAINED_MODEL)
        job = RolloutJob(self.config.env, PolicyDriver.of(self._policy), HOLD, label="last")
        found = self._evaluate(job, here / FILE_NAME, f"iteration {agent.number}")
        if agent.number == best_validation(validations(self.folder)):
            self._keep_best(self._policy)
        return found


class Agent:
    """An mlp with its own environments, and the demonstrations that it imitates, if any.

    Attributes:
        number: Iterations so far.
        simulated: Control steps so far.
        metrics: Metrics of the last iteration.
    """

    def __init__(self, config: LearningConfig, clock: Stopwatch):
        """Make the policy, its environments and its optimiser; read the demonstrations.

        Args:
            config: Options of the run.
            clock: Measures the time that iterations take.

        Raises:
            UsageError: If options do not fit each other, the policy to start from, or the
                demonstrations.
            MismatchError: If the policy to start from has another robot, task or action space.
            NothingToLearnError: If no demonstration is left, see `read_demonstrations`.
            NotFiniteError: If a number in the demonstrations is not finite.
        """
        self.config, self._clock = config, clock
        self.number = self.simulated = 0
        self.metrics: dict[str, float] = {}
        self._spec = env_spec(config.env)
        start = None if config.start is None else Checkpoint.open(config.start)
        self._conversion = start_conversion(start, config.action_space, self._spec)
        encode = self._conversion.encode
        shown = read_demonstrations(config.datasets, encode) if config.datasets else None
        horizon = config.episode_steps or config.env.horizon
        if shown and not config.episode_steps:
            horizon = min(horizon, math.ceil(LONGER * shown.longest))
        hold, rows = (shown.hold, shown.stacked) if shown else (None, None)
        with threads(1):
            seed_generators(self._stream("weights"))
            self._policy = start_policy(start, self._conversion, self._spec, rows)
            episodes = [RobotEpisode(config.env, hold) for _ in range(config.episodes)]
            self.envs = Lockstep(episodes, self._policy.model, horizon, self._conversion)
            log_std, clone = config.first_log_std, start is not None
            self._learner = Learner(self._policy.model, config.ppo, self.envs, log_std, clone=clone)
        self._expert = shown.padded(horizon, self._policy.model) if shown else None

    def discriminator(self) -> Discriminator:
        """Return an untrained discriminator, of AIRL's form if the method is `airl`, else of
        GAIL's.
        """
        seed_generators(self._stream("discriminator"))
        gamma = self.config.discount if self.config.method == "airl" else None
        return Discriminator(self.config.discriminator, self._policy.model, gamma)

    def rollouts(self) -> None:
        """Start an iteration by running its episodes."""
        count = self.config.episodes
        self.number += 1
        seed = stream_seeds("reinforcement", self.number * count, self.config.seed)[-count]
        with self._clock.timed("collect"), threads(1):
            seed_generators(self._stream("rollouts"))
            self._rows = self._learner.collect(seed)
        self.simulated += self.envs.simulated
        solved, absorbing = self.envs.solved.mean(), self._rows.absorbing.mean()
        self.metrics = {"success": float(solved), "absorbing": float(absorbing)}

    def executed(self) -> F32:
        """Return joint state, environment state and absolute action of every step of the last
        rollouts, (N, d + n).
        """
        return np.column_stack(
            [self._rows.states[:, :-1], np.concatenate(self.envs.executed)]
        ).astype(np.float32)

    def discriminate(self, d: Discriminator) -> F32:
        """Fit a discriminator to the demonstrations and the last rollouts, and return its rewards
        of these, (N,).

        The demonstrated actions get noise with the learner's initial standard deviation. Without
        this noise the discriminator would only detect the learner's exploration noise, and AIRL's
        densities would be meaningless.
        """
        if self._expert is None:
            raise UsageError(
                "no demonstrations to compare the learner with; give --dataset.root=DIR"
            )
        rng = rng_for(self._stream("discriminator"), "batches")
        with self._clock.timed("fit"), threads(1):
            expert = self._learner.explored(self._expert, rng)
            density, own = self._learner.log_prob(expert), self._learner.log_prob(self._rows)
            found = d.fit(expert, self._rows, (density, own), rng)
            rewards = d.reward(self._rows, own)
        self.metrics |= {f"discriminator_{name}": value for name, value in found.items()}
        return rewards

    def save_reward(self, d: Discriminator, folder: Path) -> None:
        """Write the reward that AIRL's discriminator holds to a `pretrained_model` folder."""
        assert self._expert is not None
        found = d.learned(
            self._policy.model, np.concatenate([self._expert.states, self._rows.states])
        )
        folder.mkdir()
        fingerprint = env_fingerprint(self.config.env)
        write_reward(folder, found, self._spec, self._options(), fingerprint)

    def improve(self, rewards: F32) -> None:
        """Update the policy by PPO with the rewards (N,) of the last rollouts."""
        self.metrics["return"] = float(rewards.sum() / self.config.episodes)
        remaining = max(0.0, 1.0 - self.simulated / self.config.steps)
        warm = self.number > self.config.warmup_iterations
        with self._clock.timed("fit"), threads(1):
            seed_generators(self._stream("updates"))
            self.metrics |= self._learner.improve(rewards, actor=warm, remaining=remaining)

    def save(self, folder: Path) -> None:
        """Write the policy to a `pretrained_model` folder, that of iteration 0 as it was given."""
        start, space = self.config.start, self._conversion.space
        if self.number == 0 and start is not None:
            shutil.copytree(start, folder)
            return
        save_policy(self._policy, self._conversion, folder)
        fingerprint = env_fingerprint(self.config.env)
        Origin.of(self._spec, fingerprint, self._options(), action_space=space).write(folder)
        # without this, other users, such as a container's, could not read them
        for path in folder.glob("*.safetensors"):
            path.chmod(folder.stat().st_mode & 0o666)

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
