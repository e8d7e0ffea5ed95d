"""The expert gets there: from the start, and from where a disturbance left it."""

from __future__ import annotations

import pytest

from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.env import EnvConfig
from manip_il.sim.events import KINDS, Perturbation

from ..tables import every_robot, every_scene, every_scene_with_an_object

SIZES = Condition("sizes", size=(0.03, 0.07), mass=(0.05, 0.3))
SMALL = Condition("small", size=(0.03, 0.03), mass=(0.3, 0.3))
KNOCKED = Condition("knocked", action_noise=(0.05, 0.05), knock=(0.05, 0.08))
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
    job = RolloutJob(EnvConfig(robot), "expert", hold=0, conditions=(KNOCKED,))
    assert failures(job, 3) == []


@pytest.mark.parametrize("at", [6, 16])  # on the way to the cube; with it in the hand
@pytest.mark.parametrize("kind", [name for name, kind in KINDS.items() if kind.change is not None])
@every_robot
def test_the_expert_recovers(robot: str, kind: str, at: int):
    seed = stream_seeds("certificate", 20)[at]
    config, condition = EnvConfig(robot, horizon=at + 100), Perturbation(kind, {seed: at})
    [episode] = run_job(RolloutJob(config, "expert", hold=0, conditions=(condition,)), [seed])
    assert episode.success
    assert len(episode) > at
