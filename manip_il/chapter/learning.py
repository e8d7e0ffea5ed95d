"""Learning by reinforcement in simulation: GAIL, AIRL and PPO, as loops over a run, and the agent
that they improve.

Each iteration runs whole episodes, with its own seeds and random streams, so a killed run that is
resumed from its last finished iteration ends with the same bytes.

    checkpoints/last/    the last finished iteration
    validation/          every validated policy and its eval.json, by iteration
    metrics.jsonl        a line per iteration
    best/                the policy with the highest validation success; on a tie the latest
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, override

import numpy as np
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from safetensors.torch import load_file, save_file

from manip_il import checks
from manip_il.algorithms.results import VALIDATION, Result, Stopwatch, best_validation, validations
from manip_il.algorithms.run import Run
from manip_il.chapter.config import LONGER, LearningConfig
from manip_il.chapter.discriminators import Discriminator
from manip_il.chapter.episodes import (
    ActionRange,
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
from manip_il.chapter.reward import LearnedReward
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import HOLD, RolloutJob
from manip_il.data.atomic import CHECKPOINT, kind_of, new_folder
from manip_il.errors import UsageError
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.learn.checkpoint import Checkpoint, Origin, in_one_line
from manip_il.learn.network import threads
from manip_il.learn.training_state import (
    PRETRAINED_MODEL,
    STEP_FILE,
    TRAINING_STATE,
    last_checkpoint,
    new_checkpoint,
)
from manip_il.mdp import F32
from manip_il.seeding import rng_for, stream_base, stream_seeds
from manip_il.worlds.table import env_fingerprint, env_spec

_CHECKPOINTS = "checkpoints"
_WEIGHTS = "weights.safetensors"


def gail(run: LearningRun, c: LearningConfig) -> Iterator[Result]:
    """Yield each iteration's result of generative adversarial imitation learning (Ho & Ermon,
    NeurIPS 2016, algorithm 1), with PPO as its policy step.
    """
    return _imitate(run, c, None)


def airl(run: LearningRun, c: LearningConfig) -> Iterator[Result]:
    """Yield each iteration's result of adversarial inverse reinforcement learning (Fu, Luo &
    Levine, ICLR 2018, algorithm 1), with PPO as its policy step.

    The discriminator is D = exp f / (exp f + pi), with the learner's density pi.
    """
    return _imitate(run, c, c.discount)


def _imitate(run: LearningRun, c: LearningConfig, gamma: float | None) -> Iterator[Result]:
    """Roll out the agent, fit the discriminator, and use its reward to improve the agent, again
    and again.
    """
    agent = run.agent()
    d = agent.discriminator(gamma)
    yield from run.begin(agent)
    while agent.simulated < c.steps:
        agent.rollouts()
        agent.improve(agent.discriminate(d))
        yield run.finish(agent)


def ppo(
    run: LearningRun, c: LearningConfig, reward: Callable[[F32], F32] | None = None
) -> Iterator[Result]:
    """Roll out the agent and improve it with a given reward, again and again.

    The method is PPO (Schulman et al. 2017).

    Args:
        run: The run, which makes the agent and saves its iterations.
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


METHODS = {"gail": gail, "airl": airl, "ppo": ppo}


class LearningRun(Run):
    """One run of GAIL, AIRL or PPO in a folder.

    Attributes:
        config: A `LearningConfig`.
    """

    @override
    def results(self) -> Iterator[Result]:
        """Run or resume the loop of `config.method`, and yield its results."""
        return self.follow(METHODS[self.config.method](self, self.config))

    def agent(self) -> Agent:
        """Return a new agent for reinforcement learning."""
        return Agent(self.config, self._clock)

    def begin(self, agent: Agent) -> Iterator[Result]:
        """Load the agent's last finished iteration and yield its result.

        Else yield that of the initial clone, if any.

        An iteration thus gets its line in `metrics.jsonl` even if the run was killed right after
        saving its checkpoint.
        """
        checkpoint, start = last_checkpoint(self.folder, resume=True), self.config.start
        if checkpoint is not None:
            agent.load(checkpoint)
            yield self._result(agent, checkpoint / PRETRAINED_MODEL)
        elif start is not None:
            yield self._result(agent, start)

    def finish(self, agent: Agent) -> Result:
        """Save the finished iteration; validate its policy if that is due."""
        folder = self.folder / _CHECKPOINTS
        made = folder / f"{agent.number:06d}"
        agent.save(made)
        for other in folder.iterdir():
            if not other.is_symlink() and other != made and kind_of(other) == CHECKPOINT:
                shutil.rmtree(other, ignore_errors=True)
        self._progress.step()
        return self._result(agent, folder / "last" / PRETRAINED_MODEL)

    def _result(self, agent: Agent, policy: Path) -> Result:
        """The result of an agent's iteration, validated if validation is due.

        Iteration 0 is always validated.
        """
        every, validated = self.config.validation_every, None
        due = agent.simulated // every != agent.validated_at // every
        if due or agent.simulated >= self.config.steps or agent.number == 0:
            agent.validated_at = agent.simulated
            validated = self._validate_copy(policy, agent.number)
        return Result(
            unit="iteration",
            number=agent.number,
            steps=agent.simulated,
            episodes=agent.number * self.config.episodes,
            metrics=agent.metrics,
            policy=policy,
            validated=validated,
            seconds=self._clock.take(),
        )

    def _validate_copy(self, policy: Path, number: int) -> EvalResult:
        """Copy a policy into the run and evaluate it, unless that is done.

        Copy it to `best` if it is the best.
        """
        here = self.folder / VALIDATION / f"{number:06d}"
        if not here.is_dir():
            with new_folder(here) as new:
                shutil.copytree(policy, new / PRETRAINED_MODEL)
        job = RolloutJob(
            self.config.env, PolicyDriver.of(here / PRETRAINED_MODEL), HOLD, label="last"
        )
        found = self._evaluate(job, here / FILE_NAME, f"iteration {number}")
        if number == best_validation(validations(self.folder)):
            self._keep_best(policy)
        return found


class Agent:
    """An mlp with its own environments, and the demonstrations that it imitates, if any.

    Attributes:
        number: Iterations so far.
        simulated: Control steps so far.
        metrics: Metrics of the last iteration.
        validated_at: Control steps at the last validation.
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
        self.number = self.simulated = self.validated_at = 0
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
            actions = ActionRange.of(self._policy.model)
            episodes = [RobotEpisode(config.env, hold) for _ in range(config.episodes)]
            self.envs = Lockstep(episodes, actions, horizon, self._conversion)
            log_std, clone = config.first_log_std, start is not None
            self._learner = Learner(self._policy.model, config.ppo, self.envs, log_std, clone=clone)
        self._modules: dict[str, Any] = {"actor_critic": self._learner.policy}
        self._expert = shown.padded(horizon, actions.normalised) if shown else None

    def discriminator(self, gamma: float | None = None) -> Discriminator:
        """Return a discriminator, which is saved with the agent.

        Args:
            gamma: Discount per control step in AIRL's f; None for GAIL's form.
        """
        seed_generators(self._stream("discriminator"))
        made = Discriminator(self.config.discriminator, self._policy.model, gamma)
        self._modules["discriminator"] = made
        return made

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

    def improve(self, rewards: F32) -> None:
        """Update the policy by PPO with the rewards (N,) of the last rollouts."""
        self.metrics["return"] = float(rewards.sum() / self.config.episodes)
        remaining = max(0.0, 1.0 - self.simulated / self.config.steps)
        warm = self.number > self.config.warmup_iterations
        with self._clock.timed("fit"), threads(1):
            seed_generators(self._stream("updates"))
            self.metrics |= self._learner.improve(rewards, actor=warm, remaining=remaining)

    def save(self, folder: Path) -> None:
        """Write a checkpoint of the iteration: its policy, and everything that the next
        iteration needs.
        """
        fingerprint, space = env_fingerprint(self.config.env), self._conversion.space
        origin = Origin.of(self._spec, fingerprint, self._options(), action_space=space)
        with new_checkpoint(folder) as new:
            save_policy(self._policy, self._conversion, new / PRETRAINED_MODEL)
            (new / TRAINING_STATE).mkdir()
            save_modules(self._modules, new / TRAINING_STATE)
            step = {
                "step": self.number,
                "simulated": self.simulated,
                "metrics": self.metrics,
                "validated_at": self.validated_at,
            }
            (new / TRAINING_STATE / STEP_FILE).write_text(json.dumps(step))
            origin.write(new / PRETRAINED_MODEL)

    def load(self, folder: Path) -> None:
        """Load a checkpoint to continue from. Raises `ManipError` if it is incomplete."""
        step = checks.read_json(folder / TRAINING_STATE / STEP_FILE, "the step of a run")
        with in_one_line(f"{folder} cannot be resumed"), threads(1):
            self.number, self.simulated = step["step"], step["simulated"]
            self.metrics, self.validated_at = step["metrics"], step["validated_at"]
            load_modules(self._modules, folder / TRAINING_STATE)

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


def save_modules(modules: Mapping[str, Any], folder: Path) -> None:
    """Write the weights of modules (name -> module), and the states of their optimisers, to a
    folder.
    """
    for name, module in modules.items():
        (folder / name).mkdir()
        save_file(module.state_dict(), folder / name / _WEIGHTS)
        save_optimizer_state(module.optimizer, folder / name)


def load_modules(modules: Mapping[str, Any], folder: Path) -> None:
    """Read what `save_modules` has written."""
    for name, module in modules.items():
        module.load_state_dict(load_file(folder / name / _WEIGHTS))
        load_optimizer_state(module.optimizer, folder / name)
