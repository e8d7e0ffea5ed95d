"""The expert gets there: from the start, and from where a disturbance left it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.expert.expert import Expert
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.disturb import Disturbance, drop_object, jolt_joints, knock_object, set_fingers
from manip_il.sim.env import EnvConfig, ManipEnv

from ..tables import every_robot, every_scene, every_scene_with_an_object

SIZES = Condition("sizes", size=(0.03, 0.07), mass=(0.05, 0.3))
SMALL = Condition("small", size=(0.03, 0.03), mass=(0.3, 0.3))
LARGE = Condition("large", size=(0.07, 0.07), mass=(0.05, 0.05))


def failures(job: RolloutJob, count: int) -> list[int]:
    return [episode.seed for episode in run_job(job, stream_seeds("certificate", count)) if not episode.success]


@every_scene
def test_the_expert_solves_every_task(robot: str, task: str):
    assert failures(RolloutJob(EnvConfig(robot, task), "expert", hold=0), 3) == []


@pytest.mark.slow
@every_scene
def test_the_expert_solves_every_task_from_40_starts(robot: str, task: str):
    assert failures(RolloutJob(EnvConfig(robot, task), "expert", hold=0), 40) == []


@every_scene_with_an_object
@pytest.mark.parametrize("condition", [SIZES, SMALL, LARGE], ids=lambda condition: condition.name)
def test_the_expert_solves_the_task_with_cubes_of_other_sizes(robot: str, task: str, condition: Condition):
    job = RolloutJob(EnvConfig(robot, task), "expert", hold=0, conditions=(condition,))
    assert failures(job, 3) == []


@pytest.mark.slow
@every_scene_with_an_object
def test_the_expert_solves_the_task_with_40_cubes(robot: str, task: str):
    job = RolloutJob(EnvConfig(robot, task), "expert", hold=0, conditions=(SIZES,))
    assert failures(job, 40) == []


@every_robot
def test_the_expert_solves_the_task_under_noise_and_a_knock(robot: str):
    job = RolloutJob(EnvConfig(robot), "expert", hold=0, disturbance=Disturbance(0.05, knock=(0.05, 0.08)))
    assert failures(job, 3) == []


Kind = Callable[[ManipEnv, np.random.Generator], object]
KINDS: dict[str, Kind] = {
    "joints off": lambda env, rng: jolt_joints(env, rng, 0.2),
    "object moved": lambda env, rng: knock_object(env, rng, (0.03, 0.1)),
    "object dropped": lambda env, rng: drop_object(env, rng, (0.0, 0.1), 0.1),
    "wrongly closed": lambda env, rng: set_fingers(env, 0.0),
    "wrongly open": lambda env, rng: set_fingers(env, env.world.most_opening),
}


def solves(env: ManipEnv, expert: Expert, steps: int, disturb: Callable[[], object], at: int) -> bool:
    for step in range(at + steps):
        if step == at:
            disturb()
            env.set_state(replace(env.get_state(), streak=0))  # what was solved before does not count
        env.advance(expert.label(env.get_state()).action)
        if step >= at and env.solved:
            return True
    return False


@pytest.mark.parametrize("at", [6, 16])  # on the way to the cube; with it in the hand
@pytest.mark.parametrize("kind", KINDS)
@every_robot
def test_the_expert_recovers(robot: str, kind: str, at: int):
    env = ManipEnv(robot)
    env.start(stream_seeds("certificate", 20)[at])
    rng = np.random.default_rng(at)
    assert solves(env, Expert(env.scene), env.config.horizon, lambda: KINDS[kind](env, rng), at)
