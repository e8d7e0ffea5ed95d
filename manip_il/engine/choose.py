"""Who drives a rollout job, and who decides when the expert is queried."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from manip_il.engine import query
from manip_il.engine.describe import env_spec
from manip_il.engine.drivers import (
    ExpertDriver,
    LearnerDriver,
    MixtureDriver,
    NoisyExpertDriver,
    QueryingDriver,
    RandomDriver,
    TakeoverDriver,
)
from manip_il.engine.sight import drawn_cameras
from manip_il.learn.pretrained import check_interface
from manip_il.rollout import Driver
from manip_il.sim.env import ManipEnv

if TYPE_CHECKING:  # torch only where a learner drives
    from manip_il.engine.jobs import RolloutJob
    from manip_il.learn.policy import LearnedPolicy


def choose_driver(job: RolloutJob, env: ManipEnv) -> Driver:
    """Return the driver of a job, with its gate. Raises what loading a policy raises."""
    if job.driver == "expert":
        return ExpertDriver()
    if job.driver == "noisy_expert":
        return NoisyExpertDriver(np.asarray(job.noise))
    if job.driver == "random":
        return RandomDriver(env.scene.actions)
    assert job.policy is not None
    policy = _load(job, job.policy, env)
    driver = LearnerDriver(policy) if job.driver == "policy" else MixtureDriver(policy, job.beta)
    if job.label == "takeover":
        return TakeoverDriver(driver, _gate(job, policy, env))
    by_rules = job.query.kind == "one" or (job.label == "per_state" and job.query.kind == "every")
    return driver if job.label == "last" or by_rules else QueryingDriver(driver, _gate(job, policy, env))


def _gate(job: RolloutJob, policy: LearnedPolicy, env: ManipEnv) -> query.Gate:
    kind, bound, scale = job.query.kind, job.query.bound, env.scene.actions.scale
    if kind == "one":
        return query.at_drawn_step(job.env.horizon)
    if kind == "probability":
        return query.by_chance(bound)
    if kind == "safety":
        return query.where_unsafe(bound, scale)
    if kind == "ensemble":
        return query.where_disputed(bound, [_load(job, path, env) for path in job.ensemble], policy.cameras, scale)
    if kind == "likelihood":
        policy.require_likelihood()
        return query.where_unsure(bound, policy)
    return query.everywhere


def _load(job: RolloutJob, path: Path, env: ManipEnv) -> LearnedPolicy:
    from manip_il.learn.policy import LearnedPolicy

    policy = LearnedPolicy.load(path, task=env.task_description, trust=job.trust)
    check_interface(policy.interface, env_spec(job.env, drawn_cameras(job)))
    return policy
