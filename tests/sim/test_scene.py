"""Bodies, contacts and the gripper's hold."""

import numpy as np
import pytest

from manip_il.robots.spec import model_bytes
from manip_il.robots.table import get_robot
from manip_il.sim.scene import build_scene
from manip_il.tasks.objects import CUBE_HALF
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import scene_of

from ..scenes import cube, drive_until, half_height, in_hand, started, still
from ..tables import every_robot, every_scene


@every_scene
def test_an_arm_told_to_stand_still_and_an_untouched_cube_do(robot: str, task: str):
    env = started(robot, task)
    q, command = env.data.qpos[env.scene.arm_q].copy(), still(env)
    lying = {name: env.world.pose(name).position.copy() for name in env.scene.objects}
    for _ in range(40):
        env.advance(command)
    np.testing.assert_allclose(env.data.qpos[env.scene.arm_q], q, atol=2e-3)
    for name, at in lying.items():
        np.testing.assert_allclose(env.world.pose(name).position, at, atol=1e-3)
        assert env.world.pose(name).position[2] == pytest.approx(
            half_height(env.world, name), abs=5e-4
        )


@every_robot
def test_a_held_cube_creeps_less_than_a_millimetre_in_5_s(robot: str):
    env = started(robot, "lift")
    drive_until(env, "at_goal")
    command = still(env, 0.0)
    for _ in range(5):  # the arm comes to rest
        env.advance(command)
    first = in_hand(env)
    assert cube(env)[2] > 2 * CUBE_HALF
    for _ in range(100):
        env.advance(command)
    assert np.linalg.norm(in_hand(env) - first) < (3e-3 if env.world.gripper.lopsided else 1e-3)


@every_scene
def test_a_scene_is_compiled_once_and_is_the_same_bytes_again(robot: str, task: str):
    scene = scene_of(robot, task)
    assert scene_of(robot, task) is scene
    assert model_bytes(build_scene.__wrapped__(get_robot(robot), TASKS[task]).model) == model_bytes(
        scene.model
    )
