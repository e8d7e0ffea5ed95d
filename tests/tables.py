"""Every robot, task and scene there is: a fact about all of them is marked with one, and holds for a new entry too."""

from __future__ import annotations

import pytest

from manip_il.robots.robot import ROBOTS
from manip_il.tasks.table import TASKS

SCENES = [(robot, task) for robot in ROBOTS for task in TASKS]
GRASPING = [(robot, task) for robot, task in SCENES if TASKS[task].grasped]

every_robot = pytest.mark.parametrize("robot", list(ROBOTS))
every_task = pytest.mark.parametrize("task", list(TASKS))
every_scene = pytest.mark.parametrize(("robot", "task"), SCENES)
every_scene_with_an_object = pytest.mark.parametrize(("robot", "task"), GRASPING)
