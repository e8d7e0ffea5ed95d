"""Every robot, task and scene there is: a fact about all of them is marked with one, and holds for
a new entry too.

Scenes are every robot with the tasks of one cube, and every other task with the first robot: what
another arm does to a fact shows in the former.
"""

import pytest

from manip_il.robots import ROBOTS
from manip_il.tasks.table import TASKS

ONE_CUBE = ("reach", "lift", "pick_place")
SCENES = [
    (robot, task)
    for robot in ROBOTS
    for task in TASKS
    if task in ONE_CUBE or robot == next(iter(ROBOTS))
]
GRASPING = [(robot, task) for robot, task in SCENES if TASKS[task].grasped]
# it may lie
WITH_A_PEG = [(robot, task) for robot, task in GRASPING if task in ("insert", "insert_tight")]
WITH_CUBES = [scene for scene in GRASPING if scene not in WITH_A_PEG]
WITH_A_CUBE = [(robot, task) for robot, task in GRASPING if task in ONE_CUBE]

BEYOND = [("so101", "sort")]  # whose bins a small arm does not reach
# what needs a table's width is beyond a small one
LARGE = [robot for robot in ROBOTS if robot != "so101"]

every_robot = pytest.mark.parametrize("robot", list(ROBOTS))
every_large_robot = pytest.mark.parametrize("robot", LARGE)
every_task = pytest.mark.parametrize("task", list(TASKS))
every_scene = pytest.mark.parametrize(("robot", "task"), SCENES)
every_scene_that_grasps = pytest.mark.parametrize(("robot", "task"), GRASPING)
every_scene_with_cubes = pytest.mark.parametrize(("robot", "task"), WITH_CUBES)
every_scene_with_a_cube = pytest.mark.parametrize(("robot", "task"), WITH_A_CUBE)


def one_arm_per_task() -> list[tuple[str, str]]:
    """Every task, with the first robot."""
    return [(next(iter(ROBOTS)), task) for task in TASKS]
