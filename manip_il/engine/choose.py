"""Who drives a rollout job, and who decides when the expert is asked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from manip_il.engine.ask import AtDrawnStep, ByChance, Everywhere, Gate, WhereDisputed, WhereUnsafe, WhereUnsure
from manip_il.engine.describe import env_spec
from manip_il.engine.drivers import (
    AskingDriver,
    ExpertDriver,
    LearnerDriver,
    MixtureDriver,
    NoisyExpertDriver,
    RandomDriver,
    TakeoverDriver,
)
from manip_il.engine.sight import drawn_cameras
from manip_il.learn.pretrained import check_interface
from manip_il.rollout import Driver
from manip_il.sim.env import ManipEnv
from manip_il.sim.robot import Robot

if TYPE_CHECKING:  # torch only where a learner drives
    from manip_il.engine.jobs import RolloutJob
    from manip_il.learn.policy import LearnedPolicy


def choose_driver(job: RolloutJob, env: ManipEnv) -> Driver:
    """The driver of a job, with its gate. Raises what loading a policy raises."""
    robot = env.scene.robot
    if job.driver == "expert":
        return ExpertDriver()
    if job.driver == "noisy_expert":
        return NoisyExpertDriver(np.asarray(job.noise))
    if job.driver == "random":
        return RandomDriver(robot.max_joint_step, robot.max_opening)
    assert job.policy is not None
    policy = _load(job, job.policy, env)
    driver = LearnerDriver(policy) if job.driver == "policy" else MixtureDriver(policy, job.beta)
    if job.labels == "takeover":
        return TakeoverDriver(driver, _gate(job, policy, env))
    by_rules = job.ask.kind == "one" or (job.labels == "per_state" and job.ask.kind == "every")
    return driver if job.labels == "last" or by_rules else AskingDriver(driver, _gate(job, policy, env))


def step_scale(robot: Robot) -> np.ndarray:
    """What differences between actions are measured in, (n,): the longest joint step [rad], the whole opening [m]."""
    scale = np.full(len(robot.joint_names), robot.max_joint_step)
    scale[-1] = robot.max_opening
    return scale


def _gate(job: RolloutJob, policy: LearnedPolicy, env: ManipEnv) -> Gate:
    kind, bound, scale = job.ask.kind, job.ask.bound, step_scale(env.scene.robot)
    if kind == "one":
        return AtDrawnStep(job.env.horizon)
    if kind == "probability":
        return ByChance(bound)
    if kind == "safety":
        return WhereUnsafe(bound, scale)
    if kind == "ensemble":
        return WhereDisputed(bound, [_load(job, path, env) for path in job.ensemble], policy.cameras, scale)
    if kind == "likelihood":
        policy.require_likelihood()
        return WhereUnsure(bound, policy)
    return Everywhere()


def _load(job: RolloutJob, path: Path, env: ManipEnv) -> LearnedPolicy:
    from manip_il.learn.policy import LearnedPolicy

    policy = LearnedPolicy.load(path, task=env.task_description, trust=job.trust)
    check_interface(policy.interface, env_spec(job.env, drawn_cameras(job)))
    return policy
