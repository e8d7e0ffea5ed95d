"""A rollout job: everything that a worker needs to turn seeds into episodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from manip_il.collect.drivers import Driver, ExpertDriver, Setting
from manip_il.collect.query import LabelMode, Query, branch, cut_at_takeover, gate_of, labelled
from manip_il.collect.rollout import Rules, rollout
from manip_il.data.episodes import group_rollouts, to_episode
from manip_il.errors import MismatchError
from manip_il.learn.checkpoint import Checkpoint
from manip_il.mdp import Episode, Transition
from manip_il.option import check_bounds
from manip_il.sim.conditions import Condition, draw
from manip_il.sim.config import CameraConfig
from manip_il.sim.shape import draws_shape
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import Environment
from manip_il.worlds.table import env_spec, make_env, make_expert

if TYPE_CHECKING:  # torch is imported only if a learner drives
    from manip_il.learn.policy import LearnedPolicy

# control steps for which an episode continues after success, to see whether success lasts
HOLD = 10
LOCKSTEP = 25  # environments that share one call of the policy
OWN_MODELS = 8  # lockstep limit if each environment has its own model (26 MB for the Panda)


@dataclass(frozen=True)
class RolloutJob:
    """Driver and environment of rollouts, their length, and what is recorded.

    Attributes:
        env: Settings of the environment.
        driver: Chooses the actions.
        hold: Control steps after success at which an episode ends; None: it ends at the horizon.
        patience: Control steps without progress after which an episode also ends; None: it never
            does so.
        label: What the expert returns in the states that `query` selects.
        query: When the expert is queried.
        branch_steps: Control steps per branch.
        conditions: Randomisations of the world, taken in turn by seed.
        batch: Largest number of episodes that share a call of the policy; it does not change
            outcomes.
        round: Number of the round, as stored in datasets.
        cameras: Cameras recorded in every step; None for none. A policy always gets the pictures
            that it needs.
    """

    env: EnvConfig
    driver: Driver = ExpertDriver()  # noqa: RUF009  # frozen
    hold: int | None = None
    patience: int | None = None
    label: LabelMode = "per_state"
    query: Query = field(default_factory=Query)
    branch_steps: int = 1
    conditions: tuple[Condition, ...] = ()
    batch: int = LOCKSTEP
    round: int = 0
    cameras: CameraConfig | None = None

    def __post_init__(self) -> None:
        check_bounds(self)

    @property
    def policy(self) -> Checkpoint | None:
        """The policy that drives."""
        return next(iter(self.driver.policies), None)

    @property
    def labels_all(self) -> bool:
        """Whether every state is labelled."""
        return self.label == "per_state" and self.query.kind == "every"

    def run(self, seeds: Sequence[int]) -> Iterator[Episode]:
        """Yield one episode per seed, in the order in which they end."""
        if not seeds:
            return
        cameras = observed_cameras(self)
        envs = [
            make_env(self.env, cameras, self.conditions)
            for _ in range(min(self._lockstep(), len(seeds)))
        ]
        noise = [one.only("sensing") for one in self.conditions]
        branch_env = None
        if self.label == "branch":
            env_spec(self.env).require("restored", "give another --label than branch")
            branch_env = make_env(self.env, self.cameras, noise)
        steps = run_steps(self, envs, seeds)
        for frames in group_rollouts(
            map(_without_pictures, steps) if self.cameras is None and cameras else steps
        ):
            drawn = draw(self.conditions, frames[0].seed, self.env.object)
            yield replace(self._to_episode(frames, branch_env), drawn=drawn)

    def _lockstep(self) -> int:
        """Return the number of environments that run in lockstep in one process."""
        if self.policy is None:
            return 1  # a single environment makes best use of the processor's cache
        varies = draws_shape(self.env.object) or any(
            one.only("model").ranges for one in self.conditions
        )
        return (
            self.batch
            if env_spec(self.env).shares_model and not varies
            else min(self.batch, OWN_MODELS)
        )

    def _to_episode(self, frames: list[Transition], branch_env: Environment | None) -> Episode:
        """Return an episode from its frames, with the labels, takeover or branches that `label`
        asks for.
        """
        beta, expert = self.driver.beta, make_expert(self.env)
        if self.label == "last":
            return to_episode(frames, self.round, beta, labelled=False)
        if self.label == "takeover":
            frames, own = cut_at_takeover(frames)
            return to_episode(frames, self.round, beta, path=own)
        frames = labelled(frames, self.query, expert)
        if branch_env is None:
            return to_episode(frames, self.round, beta)
        path = [replace(frame, label=None) for frame in frames]
        starts = [frame for frame in frames if frame.label is not None and frame.label.valid]
        found = (
            branch(branch_env, expert, one.state, one.seed, self.branch_steps) for one in starts
        )
        return to_episode([*path, *itertools.chain(*found)], self.round, beta, path=len(path))


def run_steps(
    job: RolloutJob, envs: Sequence[Environment], seeds: Iterable[int]
) -> Iterator[Transition]:
    """Run a job's episodes in these environments and yield every step.

    Args:
        job: The driver and the rules of the episodes.
        envs: Environments of the job, which run in lockstep.
        seeds: One for each episode.

    Returns:
        The transitions, in the order of `rollout`.

    Raises:
        MismatchError: if a policy does not fit the environment or the recorded cameras.
    """
    policies = tuple(_load(job, checkpoint) for checkpoint in job.driver.policies)
    setting = Setting(envs[0].actions, job.env.horizon, policies)
    patience = job.patience if env_spec(job.env).has_progress else None
    rules = Rules(job.env.horizon, job.hold, patience, takeover=job.label == "takeover")
    gate = gate_of(job.label, job.query, setting)
    return rollout(envs, seeds, job.driver.start(setting), rules, make_expert(job.env), gate)


def observed_cameras(job: RolloutJob) -> CameraConfig | None:
    """Return the cameras of a job's environments: the recorded ones, else those of its policy.

    Raises `MismatchError` if the recorded cameras do not include those of the policy.
    """
    wanted = job.policy.cameras if job.policy is not None else None
    if job.policy is None or wanted is None or job.cameras is None:
        return job.cameras or wanted
    if not set(wanted.names) <= set(job.cameras.names) or wanted.size != job.cameras.size:
        raise MismatchError(
            "choice or size of cameras", str(job.policy.path), wanted, "the recording", job.cameras
        )
    return job.cameras


def _load(job: RolloutJob, checkpoint: Checkpoint) -> LearnedPolicy:
    from manip_il.learn.policy import LearnedPolicy

    spec = env_spec(job.env, observed_cameras(job))
    checkpoint.check_fits(spec)
    driver = job.driver
    return LearnedPolicy.load(checkpoint, driver.device, spec.instruction, trust=driver.trust)


def _without_pictures(frame: Transition) -> Transition:
    return replace(frame, observation=replace(frame.observation, images={}, keypoints={}))
