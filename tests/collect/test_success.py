"""The expert gets there with cubes at the ends of their range, and from where a disturbance left
it.

From the start, in every scene: `tests/tasks/test_every_task.py`.
"""

import pytest

from manip_il.collect.job import RolloutJob
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.events import KINDS, Perturbation, kinds_for
from manip_il.tasks.table import TASKS
from manip_il.worlds.table import make_config

from ..tables import SCENES, WITH_A_CUBE

KNOCKED = Condition("knocked", action_noise=(0.05, 0.05), knock=(0.05, 0.08))


def ends(task: str) -> tuple[Condition, ...]:
    """The smallest objects that a task can take, heavy, and the largest, light."""
    sizes = TASKS[task].sizes
    assert sizes is not None
    names = zip(("small", "large"), sizes, (0.3, 0.05), strict=True)
    return tuple(
        Condition(name, size=(size, size), mass=(mass, mass)) for name, size, mass in names
    )


CASES = [(*scene, condition) for scene in WITH_A_CUBE for condition in (*ends(scene[1]), KNOCKED)]
CHANGED = [
    (robot, task, kind, at)
    for robot, task in SCENES
    for kind in kinds_for(TASKS[task])
    if KINDS[kind].change is not None
    # on the way to the cube; with it in the hand
    for at in ((6, 16) if task == "pick_place" else (6,))
]


def failures(condition: Condition, robot: str, task: str, count: int) -> list[int]:
    job = RolloutJob(make_config(robot, task), hold=0, conditions=(condition,))
    return [
        episode.seed
        for episode in job.run(stream_seeds("certificate", count))
        if not episode.success
    ]


@pytest.mark.parametrize(
    ("robot", "task", "condition"), CASES, ids=lambda case: getattr(case, "name", case)
)
def test_the_expert_solves_a_task_whatever_the_cube(robot: str, task: str, condition: Condition):
    assert failures(condition, robot, task, 3) == []


@pytest.mark.parametrize(("robot", "task", "kind", "at"), CHANGED)
def test_the_expert_recovers(robot: str, task: str, kind: str, at: int):
    seed = stream_seeds("certificate", 20)[at]
    config, condition = (
        make_config(robot, task, horizon=at + TASKS[task].horizon),
        Perturbation(kind, {seed: at}),
    )
    [episode] = RolloutJob(config, hold=0, conditions=(condition,)).run([seed])
    assert len(episode) > at
    assert episode.success
