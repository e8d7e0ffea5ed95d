"""A goal stands on something, clutter lies around the workspace, and neither touches anything."""

import math

import numpy as np
import pytest

from manip_il.robots import ROBOTS
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CAMERAS
from manip_il.sim.env import ManipEnv
from manip_il.sim.render import props
from manip_il.sim.variation import part
from manip_il.worlds.ladder.world import make_env

from ..scenes import SEED, bits, started, still
from ..tables import every_robot

CLUTTERED = Condition("cluttered", clutter=(4, 8))


def cluttered(robot: str, task: str = "pick_place", seed: int = SEED, **settings) -> ManipEnv:
    return started(robot, task, seed, conditions=[CLUTTERED], **settings)


def things(env: ManipEnv) -> list:
    """What lies around, without the stand of a goal."""
    return props(env.scene, env.data, part(env.world.variation, "clutter"))[
        len(props(env.scene, env.data)) :
    ]


@every_robot
def test_clutter_lies_on_the_table_around_the_workspace_and_apart(robot: str):
    for seed in range(SEED, SEED + 5):
        env = cluttered(robot, seed=seed)
        space, found = env.scene.robot.workspace, things(env)
        assert len(found) >= 3
        for one in found:
            x, y = (one.position[:2] - space.centre).tolist()
            assert max(abs(x), abs(y)) > space.half_width
            assert 0 < one.position[2] < 0.05
        at = [one.position[:2].tolist() for one in found]
        assert all(math.dist(a, b) > 0.01 for i, a in enumerate(at) for b in at[:i])


def test_clutter_changes_no_physics_and_follows_from_the_state():
    plain, env = started("panda"), cluttered("panda")
    for _ in range(3):
        for one in (plain, env):
            one.advance(still(one, 0.01) + 0.02)
    assert np.array_equal(plain.world.physics(), env.world.physics())
    other = make_env("panda")
    other.set_state(env.get_state())
    assert bits(other) == bits(env)
    for left, right in zip(things(env), things(other), strict=True):
        np.testing.assert_array_equal(left.position, right.position)


@pytest.mark.gl
@pytest.mark.parametrize("robot", list(ROBOTS))
def test_cameras_see_the_stand_and_clutter(robot: str):
    plain, env = started(robot, cameras=CAMERAS), cluttered(robot, cameras=CAMERAS)
    for camera in ("front", "side"):
        differs = (env.observe().images[camera] != plain.observe().images[camera]).any(axis=2)
        assert 0.001 < differs.mean() < 0.3


@pytest.mark.gl
def test_late_pictures_are_those_of_earlier_steps_and_joints_are_of_now():
    late = started(
        "panda", cameras=("front",), conditions=[Condition("late", picture_delay=(2, 2))]
    )
    prompt = started("panda", cameras=("front",))
    seen = []
    for step in range(5):
        expected, got = prompt.observe(), late.observe()
        seen.append(expected.images["front"])
        np.testing.assert_array_equal(got.images["front"], seen[max(0, step - 2)])
        np.testing.assert_array_equal(got.state, expected.state)
        for one in (prompt, late):
            one.advance(still(one, 0.01) + 0.05)
    assert not np.array_equal(seen[0], seen[-1])
