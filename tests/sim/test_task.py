"""Where objects and goals start."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import UnknownName
from manip_il.seeding import rng_for
from manip_il.sim.robot import ROBOTS, get_robot
from manip_il.sim.task import TASKS, Start, draw_start, get_task, in_reach
from manip_il.sim.world import CUBE_HALF_SIZE

seeds = st.integers(0, 2**40)
robots, tasks = st.sampled_from(sorted(ROBOTS)), st.sampled_from(sorted(TASKS))


def start(robot: str, task: str, seed: int) -> Start:
    return draw_start(get_task(task), get_robot(robot), rng_for(seed, "reset"))


@given(robots, tasks, seeds)
def test_a_start_lies_in_its_ranges(robot_name: str, task_name: str, seed: int):
    robot, task, drawn = get_robot(robot_name), get_task(task_name), start(robot_name, task_name, seed)
    from_centre = drawn.object_xy - robot.workspace
    assert np.abs(from_centre).max() <= task.object_range
    assert np.hypot(*from_centre) >= task.min_start_distance
    assert abs(drawn.object_yaw) <= np.pi / 4
    assert 0 <= drawn.opening <= robot.max_opening
    assert drawn.joint_offset.shape == (len(robot.arm_joints),)
    assert np.abs(drawn.joint_offset).max() <= 0.03


@given(robots, tasks, seeds)
def test_object_and_goal_are_within_reach(robot_name: str, task_name: str, seed: int):
    robot, drawn = get_robot(robot_name), start(robot_name, task_name, seed)
    assert in_reach(robot, np.append(drawn.object_xy, CUBE_HALF_SIZE))
    if task_name != "lift":
        assert in_reach(robot, drawn.goal)


@given(robots, seeds)
def test_a_goal_of_pick_and_place_is_over_the_table(robot_name: str, seed: int):
    robot, task, drawn = get_robot(robot_name), get_task("pick_place"), start(robot_name, "pick_place", seed)
    assert np.abs(drawn.goal[:2] - robot.workspace).max() <= task.goal_range
    assert CUBE_HALF_SIZE <= drawn.goal[2] <= CUBE_HALF_SIZE + task.goal_height


@given(robots, seeds)
def test_lifts_goal_is_above_the_object(robot_name: str, seed: int):
    drawn = start(robot_name, "lift", seed)
    np.testing.assert_array_equal(drawn.goal[:2], drawn.object_xy)
    assert 0.1 <= drawn.goal[2] - CUBE_HALF_SIZE <= 0.25


@pytest.mark.parametrize("robot", ROBOTS)
def test_half_the_goals_of_pick_and_place_are_on_the_table(robot: str):
    on_table = sum(start(robot, "pick_place", seed).goal[2] == CUBE_HALF_SIZE for seed in range(400))
    assert 150 <= on_table <= 250  # five standard deviations of a fair coin


@pytest.mark.parametrize("robot", ROBOTS)
def test_starts_reach_into_every_quarter_of_the_table(robot: str):
    centre = get_robot(robot).workspace
    quarters = {tuple(start(robot, "pick_place", seed).object_xy > centre) for seed in range(100)}
    assert len(quarters) == 4


def test_an_unknown_name_answers_with_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'reach'"):
        get_task("reahc")
    with pytest.raises(UnknownName, match="known: fetch, panda"):
        get_robot("ur5")
