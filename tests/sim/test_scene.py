"""Bodies, contacts and the gripper's hold."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from manip_il.mdp import Phase
from manip_il.sim.env import ManipEnv
from manip_il.sim.scene import arm_model, build_scene
from manip_il.sim.world import CUBE_HALF_SIZE, CUBE_MASS

ROBOTS = ("panda", "fetch")
SEED = 5_000_000
FURNITURE = {"table", "floor", "pedestal", "object", "leg0", "leg1", "leg2", "leg3"}


def touching(env: ManipEnv) -> set[frozenset[str]]:
    model = env.scene.model
    pairs = ((model.geom(c.geom1).name, model.geom(c.geom2).name) for c in env.data.contact)
    return {frozenset(name if name in FURNITURE else "robot" for name in pair) for pair in pairs}


@pytest.mark.parametrize("robot", ROBOTS)
def test_at_the_start_the_robot_touches_nothing(robot: str):
    env = ManipEnv(robot)
    for seed in range(SEED, SEED + 20):
        env.start(seed)
        assert touching(env) <= {frozenset(["object", "table"]), frozenset(["robot"])}
        assert all(contact.dist > -1e-4 for contact in env.data.contact)


@pytest.mark.parametrize("robot", ROBOTS)
def test_at_home_the_hand_points_down_over_the_workspace(robot: str):
    scene = build_scene(robot, "reach")
    data = mujoco.MjData(scene.model)
    data.qpos[scene.arm_q] = scene.robot.home
    mujoco.mj_forward(scene.model, data)
    rotation = data.site_xmat[scene.ee_site].reshape(3, 3)
    np.testing.assert_allclose(rotation, np.diag([1.0, -1.0, -1.0]), atol=0.05)
    assert np.hypot(*(data.site_xpos[scene.ee_site][:2] - scene.robot.workspace)) < 0.06


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_arm_told_to_stand_still_stands_still(robot: str):
    env = ManipEnv(robot, "reach")
    env.start(SEED)
    q = env.data.qpos[env.scene.arm_q].copy()
    command = np.append(q, 2 * env.data.ctrl[env.scene.finger_ctrl[0]])
    for _ in range(40):
        env.advance(command)
    np.testing.assert_allclose(env.data.qpos[env.scene.arm_q], q, atol=2e-3)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_opening_that_is_commanded_is_the_opening_that_is_measured(robot: str):
    env = ManipEnv(robot, "reach")
    env.start(SEED)
    for opening in (env.scene.robot.max_opening, 0.03, 0.0):
        command = np.append(env.data.ctrl[env.scene.arm_ctrl], opening)
        for _ in range(20):
            env.advance(command)
        assert env.observe().state[-1] == pytest.approx(opening, abs=2e-3)


def test_an_untouched_cube_lies_still():
    env = ManipEnv()
    env.start(SEED)
    before = cube(env)
    command = np.append(env.data.ctrl[env.scene.arm_ctrl], 0.04)
    for _ in range(40):
        env.advance(command)
    np.testing.assert_allclose(cube(env), before, atol=1e-3)
    assert cube(env)[2] == pytest.approx(CUBE_HALF_SIZE, abs=5e-4)


def test_the_cube_weighs_what_the_constant_says():
    assert build_scene("panda", "lift").model.body("object").mass[0] == CUBE_MASS


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_held_cube_creeps_less_than_a_millimetre_in_5_s(robot: str, drive_until):
    env = ManipEnv(robot, "lift")
    env.start(SEED)
    drive_until(env, Phase.AT_GOAL)
    command = np.append(env.data.ctrl[env.scene.arm_ctrl], 0.0)
    for _ in range(5):  # the arm comes to rest
        env.advance(command)
    first = in_hand(env)
    assert cube(env)[2] > 2 * CUBE_HALF_SIZE
    for _ in range(100):
        env.advance(command)
    assert np.linalg.norm(in_hand(env) - first) < 1e-3


def cube(env: ManipEnv) -> np.ndarray:
    return env.data.joint("object").qpos[:3].copy()


def in_hand(env: ManipEnv) -> np.ndarray:
    """The cube's centre in the hand's frame [m]."""
    data, scene = env.data, env.scene
    offset = cube(env) - data.site_xpos[scene.ee_site]
    return data.site_xmat[scene.ee_site].reshape(3, 3).T @ offset


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_arm_alone_stands_where_the_scenes_arm_does(robot: str):
    scene = build_scene(robot, "pick_place")
    alone, data = arm_model(scene.robot), mujoco.MjData(scene.model)
    alone_data = mujoco.MjData(alone)
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = np.asarray(scene.robot.home) + rng.uniform(-0.5, 0.5, 7)
        data.qpos[scene.arm_q] = q
        alone_data.qpos[[alone.joint(name).qposadr[0] for name in scene.robot.arm_joints]] = q
        mujoco.mj_kinematics(scene.model, data)
        mujoco.mj_kinematics(alone, alone_data)
        site = alone.site("ee").id
        np.testing.assert_allclose(alone_data.site_xpos[site], data.site_xpos[scene.ee_site], atol=1e-12)
        np.testing.assert_allclose(alone_data.site_xmat[site], data.site_xmat[scene.ee_site], atol=1e-12)


def test_a_scene_is_compiled_once_and_is_the_same_bytes_again():
    scene = build_scene("fetch", "lift")
    assert build_scene("fetch", "lift") is scene
    assert build_scene.__wrapped__("fetch", "lift").model_bytes() == scene.model_bytes()
    assert build_scene("fetch", "reach").model_bytes() != scene.model_bytes()
