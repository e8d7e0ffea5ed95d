"""One rollout job: all that a worker must know to turn seeds into episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from manip_il.data.episodes import group_rollouts, to_episode
from manip_il.engine import drivers
from manip_il.engine.drivers import LabelMode, QueryRule, drawn_step
from manip_il.engine.environments import env_actions, env_spec, policy_cameras
from manip_il.engine.simulations import RestorableEnvironment, simulation_of
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.pretrained import check_interface
from manip_il.mdp import Actor, Episode, State, Transition
from manip_il.rollout import Driver, Labeller, Rules, rollout
from manip_il.sim.conditions import Condition, draw
from manip_il.sim.config import CameraConfig, EnvConfig
from manip_il.sim.scene import SCENES_KEPT
from manip_il.sim.shape import draws_shape

if TYPE_CHECKING:  # torch only where a learner drives
    from manip_il.learn.policy import LearnedPolicy

LOCKSTEP = 25  # environments that share one call of the policy
OWN_MODELS = 8  # at most so many where each needs a model of its own, which is 26 MB for the Panda


@dataclass(frozen=True)
class RolloutJob:
    """Driver and environment of rollouts, their length, and what is kept of them.

    policy: a checkpoint's `pretrained_model` folder, needed where a learner drives; ensemble: others that answer with
    it where `query` wants their disagreement. beta: the share of steps that the expert drives (`mixture`). noise: the
    covariance (n, n) of a noisy expert's actions. hold: end an episode this many steps after success; None: at the
    horizon. patience: end it after this many steps without progress.

    label: what the expert gives in the states that `query` selects. `per_state`: its label. `takeover`: from the
    first one on it drives to the end, for which it has a horizon of its own. `branch`: in a copy of the simulator it
    drives `branch_steps` ahead. `last`: none of this, but the label of the last state, for its phase.

    conditions: what episodes differ in from the nominal world, in turn by their seeds; none: nothing.

    batch: episodes that share one call of the policy, at most; it changes no outcome. trust: whether models that the
    policies' checkpoints name may be loaded.

    cameras: what is pictured in every step and kept; None for nothing. A policy that looks at cameras gets their
    pictures all the same.
    """

    env: EnvConfig
    driver: Literal["expert", "noisy_expert", "policy", "mixture", "random"]
    policy: Path | None = None
    ensemble: tuple[Path, ...] = ()
    beta: float = 0.0
    noise: tuple[tuple[float, ...], ...] = ()
    hold: int | None = None
    patience: int | None = None
    label: LabelMode = "per_state"
    query: QueryRule = field(default_factory=QueryRule)
    branch_steps: int = 1
    conditions: tuple[Condition, ...] = ()
    batch: int = LOCKSTEP
    round: int = 0
    cameras: CameraConfig | None = None
    trust: bool = False

    def __post_init__(self) -> None:
        if self.driver in ("policy", "mixture") and self.policy is None:
            raise UsageError(f"a rollout driven by {self.driver!r} needs a policy's folder")
        if self.driver == "noisy_expert" and not self.noise:
            raise UsageError("a rollout driven by 'noisy_expert' needs its noise")
        if self.label == "takeover" and self.driver != "policy":
            raise UsageError(f"the expert takes over from a policy; this rollout is driven by {self.driver!r}")
        if self.query.kind == "ensemble" and not self.ensemble:
            raise UsageError("query=ensemble needs other policies to disagree with")
        if self.batch < 1:
            raise UsageError(f"batch is {self.batch}; expected at least 1")
        if self.branch_steps < 1:
            raise UsageError(f"branch_steps is {self.branch_steps}; expected at least 1")

    @property
    def learned(self) -> bool:
        """Whether a policy drives."""
        return self.policy is not None

    @property
    def files(self) -> Path | None:
        """A folder that workers on other machines need a copy of."""
        return self.policy

    def with_files(self, files: Path) -> RolloutJob:
        """Return the same where its folder has been copied to."""
        return replace(self, policy=files)

    def run(self, seeds: Sequence[int]) -> Iterator[Episode]:
        """Yield one episode a seed, in the order in which they end."""
        return run_job(self, seeds)

    @property
    def labels_all(self) -> bool:
        """True where every state gets its label, whoever drives."""
        return self.label == "per_state" and self.query.kind == "every"


def run_job(job: RolloutJob, seeds: Sequence[int]) -> Iterator[Episode]:
    """Yield one episode a seed, in the order in which they end."""
    if not seeds:
        return
    cameras = observed_cameras(job)
    make = simulation_of(job.env.robot).make
    envs = [make(job.env, cameras, job.conditions) for _ in range(min(lockstep(job), len(seeds)))]
    expert = _expert(job.env)
    steps = run_steps(job, envs, seeds)
    if job.cameras is None and cameras is not None:
        steps = map(_without_pictures, steps)
    branch_env = BranchEnv(make(job.env, job.cameras)) if job.label == "branch" else None
    for frames in group_rollouts(steps):
        drawn = draw(job.conditions, frames[0].seed, job.env.object).values
        yield replace(_to_episode(job, frames, expert, branch_env), drawn=drawn)


def run_steps(
    job: RolloutJob, envs: Sequence[RestorableEnvironment], seeds: Iterable[int], driver: Driver | None = None
) -> Iterator[Transition]:
    """Yield every step of a job's episodes as it happens in these environments. driver: in place of the job's own."""
    return rollout(envs, seeds, driver or _make_driver(job, envs[0]), _rules(job), _expert(job.env))


def lockstep(job: RolloutJob) -> int:
    """Return how many environments of a job run in lockstep in one process."""
    if job.policy is None:
        return 1  # alone, an environment has the processor's cache
    varies = draws_shape(job.env.object) or any(one.changes_model() for one in job.conditions)
    shared = simulation_of(job.env.robot).shares_models and not varies
    return job.batch if shared else min(job.batch, OWN_MODELS)


def observed_cameras(job: RolloutJob) -> CameraConfig | None:
    """Return the cameras of a job's environments: those that are recorded, else those that its policy looks at.

    Raises `MismatchError` where the policy would not find its pictures among the recorded ones.
    """
    wanted = policy_cameras(job.policy) if job.policy is not None else None
    if wanted is None or job.cameras is None:
        return job.cameras or wanted
    if not set(wanted.names) <= set(job.cameras.names):
        raise MismatchError("cameras", str(job.policy), wanted.names, "the recording", job.cameras.names)
    if wanted.size != job.cameras.size:
        raise MismatchError("size of pictures", str(job.policy), wanted.size, "the recording", job.cameras.size)
    return job.cameras


def _make_driver(job: RolloutJob, env: RestorableEnvironment) -> Driver:
    """The driver of a job, with its gate. Raises what loading a policy raises."""
    if job.driver == "expert":
        return drivers.ExpertDriver()
    if job.driver == "noisy_expert":
        return drivers.NoisyExpertDriver(np.asarray(job.noise))
    if job.driver == "random":
        return drivers.RandomDriver(env_actions(job.env))
    assert job.policy is not None
    policy = _load(job, job.policy, env)
    driver = drivers.LearnerDriver(policy) if job.driver == "policy" else drivers.MixtureDriver(policy, job.beta)
    if job.label == "takeover":
        return drivers.TakeoverDriver(driver, _gate(job, policy, env))
    if job.label == "last" or job.labels_all or job.query.kind == "one":  # `_rules` or `_to_episode` query
        return driver
    return drivers.QueryingDriver(driver, _gate(job, policy, env))


def _gate(job: RolloutJob, policy: LearnedPolicy, env: RestorableEnvironment) -> drivers.Gate:
    kind, bound, scale = job.query.kind, job.query.bound, env_actions(job.env).scale
    if kind == "one":
        return drivers.at_drawn_step(job.env.horizon)
    if kind == "probability":
        return drivers.by_chance(bound)
    if kind == "safety":
        return drivers.on_gap(bound, scale)
    if kind == "ensemble":
        return drivers.on_disagreement(bound, [_load(job, path, env) for path in job.ensemble], scale)
    if kind == "likelihood":
        policy.require_likelihood()
        return drivers.on_low_likelihood(bound, policy)
    return drivers.at_every_step()


def _load(job: RolloutJob, path: Path, env: RestorableEnvironment) -> LearnedPolicy:
    from manip_il.learn.policy import LearnedPolicy

    policy = LearnedPolicy.load(path, task=env.task_description, trust=job.trust)
    check_interface(policy.interface, env_spec(job.env, observed_cameras(job)))
    return policy


def _rules(job: RolloutJob) -> Rules:
    if job.label == "last":
        return Rules(job.env.horizon, job.hold, job.patience, "last")
    twice = 2 if job.label == "takeover" else 1  # a horizon for the learner, and one for the expert
    return Rules(twice * job.env.horizon, job.hold, job.patience, "every" if job.labels_all else "driver")


def _to_episode(job: RolloutJob, frames: list[Transition], expert: Labeller, branch_env: BranchEnv | None) -> Episode:
    if job.label == "last":
        return to_episode(frames, job.round, job.beta, labelled=False)
    if job.label == "takeover":
        return to_episode(_cut_at_takeover(frames, job.env.horizon), job.round, job.beta)
    if job.query.kind == "one":
        step = drawn_step(frames[0].seed, len(frames))
        frames[step] = replace(frames[step], label=expert.label(frames[step].state))
    if branch_env is None:
        return to_episode(frames, job.round, job.beta)
    path = [replace(frame, label=None) for frame in frames]
    branches = (
        step
        for frame in frames
        if frame.label is not None and frame.label.valid
        for step in branch(branch_env, expert, frame.state, frame.seed, job.branch_steps)
    )
    return to_episode([*path, *branches], job.round, job.beta, path=len(path))


def _cut_at_takeover(frames: list[Transition], horizon: int) -> list[Transition]:
    """The learner's frames as a part of their own, with its end; all of them, up to the horizon, where it drove on."""
    taken = next((i for i, frame in enumerate(frames) if frame.actor != Actor.LEARNER), None)
    if taken == 0:
        return frames
    last = min(len(frames) if taken is None else taken, horizon) - 1
    rest = [] if taken is None else frames[taken:]
    return [*frames[:last], replace(frames[last], done=True), *rest]


class BranchEnv:
    """An environment of which every episode begins in `first`."""

    first: State

    def __init__(self, env: RestorableEnvironment):
        self._env = env
        self.begin_step, self.advance, self.observe, self.get_state = (
            *(env.begin_step, env.advance, env.observe, env.get_state),
        )

    def start(self, seed: int) -> None:
        """Begin the episode."""
        self._env.set_state(self.first)

    @property
    def solved(self) -> bool:
        """State of the task."""
        return self._env.solved

    @property
    def reward(self) -> float:
        """Reward of the last control step."""
        return self._env.reward

    @property
    def progress(self) -> float:
        """Share of the task that is done."""
        return self._env.progress

    @property
    def world(self) -> object | None:
        """Physics in the present state."""
        return self._env.world


def branch(env: BranchEnv, expert: Labeller, first: State, seed: int, steps: int) -> Iterator[Transition]:
    """Yield the expert's next steps from a state; the last one is `done`."""
    env.first = first
    yield from rollout([env], [seed], drivers.ExpertDriver(), Rules(steps), expert)


def _without_pictures(transition: Transition) -> Transition:
    final = replace(transition.final, images={}, keypoints={}) if transition.final else None
    return replace(transition, observation=replace(transition.observation, images={}, keypoints={}), final=final)


@lru_cache(SCENES_KEPT)
def _expert(config: EnvConfig) -> Labeller:
    return simulation_of(config.robot).expert(config)
