"""A gripper is an opening [m] between pads, whatever drives the fingers."""

import re
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

from manip_il.errors import UsageError
from manip_il.robots.geometry import distance, outline
from manip_il.robots.gripper import TOUCH, sweep
from manip_il.robots.table import get_robot
from manip_il.sim.world import World
from manip_il.tasks.pick_place import OBJECT

from ..scenes import started, still, world_at_home
from ..tables import every_robot
from .own import model_of, tree_of, write

EDGE = 0.05  # of the model's cube [m]


world_of = cache(world_at_home)


def with_cube(robot: str, opening: float, offset: tuple[float, float, float]) -> World:
    """At home, the cube between the fingers, off their middle by an offset in the hand's frame
    [m].
    """
    world, quat = world_of(robot), np.empty(4)
    gripper = world.scene.gripper
    world.data.qpos[gripper.q] = gripper.command(opening)
    world.update()
    mujoco.mju_mat2Quat(quat, world.ee.rotation.ravel())
    middle = np.array([0.0, world.gripper.middle(opening), 0.0])
    world.place(OBJECT, world.ee.position + world.ee.rotation @ (middle + offset), quat)
    world.update()
    return world


@every_robot
def test_the_opening_that_is_commanded_is_the_opening_that_is_measured(robot: str):
    env = started(robot, "reach")
    gripper = env.scene.gripper
    for opening in (gripper.most, 0.03, 0.055, 0.01, gripper.least):
        for _ in range(25):
            env.advance(still(env, opening))
        assert env.world.opening == pytest.approx(opening, abs=1e-3)
        _, observed = env.scene.actions.split(env.observe().state)
        assert observed == pytest.approx(env.world.opening, abs=1e-7)


@every_robot
def test_the_measured_opening_is_the_gap_between_the_pads(robot: str):
    world = world_of(robot)
    gripper = world.scene.gripper
    for opening in np.linspace(gripper.least + 0.005, gripper.most, 9):
        world.data.qpos[gripper.q] = gripper.command(opening)
        world.update()
        gap = min(
            distance(world.model, world.data, one, other)
            for one in gripper.pads[0]
            for pads in gripper.pads[1:]
            for other in pads
        )
        assert world.opening == pytest.approx(gap, abs=1e-3)


def test_a_gap_that_stops_growing_is_refused_where_it_does_with_the_joints_that_nothing_drives(
    tmp_path: Path,
):
    tree = tree_of("hinges")
    tree["gripper"] |= {"joints": ["right"], "closed": [-0.2], "open": [2.8]}
    model = model_of("hinges").replace('range="-0.4 0.8"', 'range="-0.4 3"')
    with pytest.raises(UsageError, match=r"(?s)as right goes.*undriven: left") as refused:
        sweep(get_robot(write(tmp_path, tree=tree, model=model)))
    numbers = r"from (\S+) to (\S+) m as right goes from (\S+) to (\S+);"
    before, after, start, end = map(float, re.search(numbers, str(refused.value)).groups())
    assert before >= after > 0.05
    assert 0.8 < start < end < 2.8


@pytest.mark.parametrize(
    ("openings", "offset", "touched"),
    [
        ([EDGE, EDGE + TOUCH], (0, 0, 0), True),
        (np.linspace(EDGE + 3 * TOUCH, 0.1, 25), (0, 0, 0), False),  # as far as they open
        ([EDGE + 0.015], (0, -0.0075, 0), False),  # one finger is at it
        ([EDGE + 0.015], (0, 0.0075, 0), False),
        ([EDGE], (0.15, 0, 0), False),
        ([EDGE], (0, 0.15, 0), False),
        ([EDGE], (0, 0, 0.08), False),
    ],
)
@every_robot
def test_the_cube_is_touched_by_all_fingers_or_not_at_all(
    robot: str, openings, offset, touched: bool
):
    for opening in openings:
        assert with_cube(robot, opening, offset).touched(OBJECT) == touched


@every_robot
def test_the_lowest_hand_keeps_its_fingers_off_the_table(robot: str):
    world = world_of(robot)
    gripper, table = world.scene.gripper, world.model.geom("table")
    top = float(table.pos[2] + table.size[2])
    for opening in (gripper.least, gripper.most):
        world.data.qpos[gripper.q] = gripper.command(opening)
        world.update()
        lowest = min(
            float(outline(world.model, world.data, geom)[:, 2].min()) for geom in gripper.geoms
        )
        assert lowest - (float(world.ee.position[2]) - world.robot.ee.lowest) > top + 1e-3
