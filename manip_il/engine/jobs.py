"""One rollout job: all that a worker must know to turn seeds into episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal, cast

from manip_il.data.episodes import group_episodes
from manip_il.engine.describe import env_spec
from manip_il.engine.drivers import ExpertDriver, LearnerDriver, MixtureDriver, RandomDriver
from manip_il.engine.sight import drawn_cameras
from manip_il.errors import UsageError
from manip_il.expert.expert import Expert
from manip_il.learn.pretrained import check_interface
from manip_il.mdp import Episode, Transition
from manip_il.rollout import Driver, Environment, Intruder, Rules, rollout
from manip_il.sim.disturb import Disturbance, Disturber
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.look import CameraConfig
from manip_il.sim.scene import build_scene

LOCKSTEP = 25  # environments that share one call of the policy


@dataclass(frozen=True)
class RolloutJob:
    """Who drives in which environment, for how long, and what is kept.

    policy: a checkpoint's `pretrained_model` folder, needed where a learner drives. beta: the share of steps
    that the expert drives (`mixture`). hold: end an episode this many steps after success; None: at the horizon.
    cameras: what is pictured in every step and kept; None for nothing. A policy that looks at cameras is shown them
    all the same.
    """

    env: EnvConfig
    driver: Literal["expert", "policy", "mixture", "random"]
    policy: Path | None = None
    beta: float = 0.0
    hold: int | None = None
    labels: Literal["all", "last"] = "all"
    disturbance: Disturbance = field(default_factory=Disturbance)
    round: int = 0
    cameras: CameraConfig | None = None

    def __post_init__(self) -> None:
        if self.driver in ("policy", "mixture") and self.policy is None:
            raise UsageError(f"a rollout driven by {self.driver!r} needs a policy's folder")


def run_job(job: RolloutJob, seeds: Sequence[int]) -> Iterator[Episode]:
    """Yield one episode a seed, in the order in which they end."""
    side_by_side = LOCKSTEP if job.policy is not None else 1  # alone, an environment has the processor's cache
    if not seeds:
        return
    cameras = drawn_cameras(job)
    envs = [_environment(job.env, cameras) for _ in range(min(side_by_side, len(seeds)))]
    rules = Rules(job.env.horizon, job.hold, "all" if job.driver in ("expert", "mixture") else job.labels)
    transitions = rollout(
        envs, seeds, _driver(job, envs[0]), rules, _expert(job.env.robot, job.env.task), _intrude(job.disturbance)
    )
    if job.cameras is None and cameras is not None:
        transitions = map(_without_pictures, transitions)
    yield from group_episodes(transitions, job.round, job.beta)


def _environment(env: EnvConfig, cameras: CameraConfig | None) -> ManipEnv:
    if cameras is None:
        return ManipEnv(config=env)
    return ManipEnv(config=env, cameras=cameras.names, image_size=cameras.size, look=cameras.look)


def _without_pictures(transition: Transition) -> Transition:
    return replace(transition, observation=replace(transition.observation, images={}))


@cache
def _expert(robot: str, task: str) -> Expert:
    return Expert(build_scene(robot, task))


def _driver(job: RolloutJob, env: ManipEnv) -> Driver:
    if job.driver == "expert":
        return ExpertDriver()
    if job.driver == "random":
        return RandomDriver(env.scene.robot.max_joint_step, env.scene.robot.max_opening)
    from manip_il.learn.policy import LearnedPolicy  # torch only where a learner drives

    assert job.policy is not None
    policy = LearnedPolicy.load(job.policy, task=env.task_description)
    check_interface(policy.interface, env_spec(job.env, drawn_cameras(job)))
    return LearnerDriver(policy) if job.driver == "policy" else MixtureDriver(policy, job.beta)


def _intrude(disturbance: Disturbance):
    if disturbance == Disturbance():
        return None

    def make(env: Environment, seed: int) -> Intruder:
        return Disturber(cast(ManipEnv, env), disturbance, seed)

    return make
