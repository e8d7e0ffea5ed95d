"""The tasks: where objects and goals start, and what counts as success."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UnknownName, UsageError
from manip_il.sim.robot import Robot
from manip_il.sim.world import CUBE_HALF_SIZE

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Task:
    """One task. Ranges are those of gymnasium-robotics' FetchPickAndPlace unless said otherwise."""

    name: str
    has_object: bool
    goal: Literal["anywhere", "above_object"]
    instruction: str
    object_range: float = 0.15  # object's start: +- this about the workspace's centre, x and y [m]
    object_yaw: float = np.pi / 4  # +- this: every orientation of a cube on the table (stock: 0) [rad]
    goal_range: float = 0.15  # goal: +- this about the workspace's centre, x and y [m]
    goal_height: float = 0.45  # highest goal over the table [m]
    goal_in_air: float = 0.5  # share of the goals that are off the table
    min_start_distance: float = 0.1  # of object or goal from the hand, x and y (stock) [m]


TASKS = {
    "reach": Task(
        "reach", has_object=False, goal="anywhere", instruction="Move the hand to the green goal.", goal_in_air=1.0
    ),
    "lift": Task("lift", has_object=True, goal="above_object", instruction="Lift the cube to the green goal above it."),
    "pick_place": Task(
        "pick_place", has_object=True, goal="anywhere", instruction="Pick up the cube and bring it to the green goal."
    ),
}
_LIFT_HEIGHT = (0.1, 0.25)  # of lift's goal over the resting object [m]
_MAX_DRAWS = 1_000


def get_task(name: str) -> Task:
    """The table's entry; raises `UnknownName`."""
    if name not in TASKS:
        raise UnknownName("task", name, TASKS)
    return TASKS[name]


@dataclass(frozen=True)
class Start:
    """What a reset draws, in [m] and [rad]. object_xy: (2,); goal: (3,); joint_offset from home: (arm,)."""

    object_xy: F64
    object_yaw: float
    goal: F64
    joint_offset: F64
    opening: float


def draw_start(task: Task, robot: Robot, rng: np.random.Generator) -> Start:
    """Draw object, goal and arm posture; draws out of the arm's reach are drawn again."""
    centre = np.array(robot.workspace)
    object_xy = _draw_until(lambda: centre + rng.uniform(-1, 1, 2) * task.object_range, robot, task)
    yaw = float(rng.uniform(-1, 1) * task.object_yaw)
    goal = _draw_goal(task, robot, object_xy, rng)
    joint_offset = rng.uniform(-1, 1, len(robot.arm_joints)) * _JOINT_JITTER
    return Start(object_xy, yaw, goal, joint_offset, rng.uniform(0, robot.max_opening))


_JOINT_JITTER = 0.03  # [rad]


def _draw_until(draw: Callable[[], F64], robot: Robot, task: Task) -> F64:
    for _ in range(_MAX_DRAWS):
        xy = draw()
        if np.linalg.norm(xy - robot.workspace) >= task.min_start_distance and in_reach(robot, _on_table(xy)):
            return xy
    raise UsageError(f"task {task.name}: no object position within reach of {robot.name} in {_MAX_DRAWS} draws")


def _draw_goal(task: Task, robot: Robot, object_xy: F64, rng: np.random.Generator) -> F64:
    if task.goal == "above_object":
        return _on_table(object_xy) + [0, 0, rng.uniform(*_LIFT_HEIGHT)]
    in_air = rng.uniform() < task.goal_in_air
    for _ in range(_MAX_DRAWS):
        xy = np.array(robot.workspace) + rng.uniform(-1, 1, 2) * task.goal_range
        goal = _on_table(xy) + [0, 0, rng.uniform(0, task.goal_height) if in_air else 0.0]
        if in_reach(robot, goal):
            return goal
    raise UsageError(f"task {task.name}: no goal within reach of {robot.name} in {_MAX_DRAWS} draws")


def in_reach(robot: Robot, position: F64, slack: float = 0.0) -> bool:
    """Whether the hand, pointing down, gets its `ee` to `position` [m], (3,); `slack` [m] widens the reach."""
    x, y, z = position
    wrist = (x, y, z + robot.wrist_above_ee)
    if robot.head is not None and math.dist(wrist, robot.head) < robot.head_clearance - slack:
        return False
    return math.dist(wrist, robot.shoulder) <= robot.reach + slack


def _on_table(xy: F64) -> F64:
    return np.array([xy[0], xy[1], CUBE_HALF_SIZE])
