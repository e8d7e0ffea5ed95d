"""Disturbances change what they say by what they say, and leave a world that can be."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from manip_il.errors import UsageError
from manip_il.robots.robot import ROBOTS
from manip_il.sim.disturb import (
    STANDARD,
    Disturbance,
    Disturber,
    drop_object,
    jolt_joints,
    knock_object,
    noisy,
    set_fingers,
)
from manip_il.sim.env import ManipEnv
from manip_il.tasks.objects import CUBE_HALF

SEED = 5_000_000


@pytest.fixture(params=list(ROBOTS))
def env(request) -> ManipEnv:
    env = ManipEnv(request.param)
    env.start(SEED)
    return env


def cube(env: ManipEnv) -> np.ndarray:
    return env.data.joint("object").qpos[:3].copy()


def arm(env: ManipEnv) -> np.ndarray:
    return env.data.qpos[env.scene.arm_q].copy()


def opening_of(env: ManipEnv) -> float:
    return float(env.observe().state[env.scene.actions.gripper])


def deepest(env: ManipEnv) -> float:
    mujoco.mj_forward(env.world.model, env.data)
    return min((contact.dist for contact in env.data.contact), default=0.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_knock_moves_the_object_alone_and_by_its_distance(env: ManipEnv, seed: int):
    before, q = cube(env), arm(env)
    assert knock_object(env, np.random.default_rng(seed), (0.05, 0.08))
    moved = cube(env) - before
    assert 0.05 <= np.hypot(*moved[:2]) <= 0.08
    assert cube(env)[2] == pytest.approx(CUBE_HALF, abs=1e-3)
    assert env.world.reach.has(cube(env))
    np.testing.assert_array_equal(arm(env), q)
    assert deepest(env) > -0.004


@pytest.mark.parametrize("seed", range(5))
def test_a_dropped_object_falls_onto_the_table(env: ManipEnv, seed: int):
    assert drop_object(env, np.random.default_rng(seed), (0.05, 0.1), 0.1)
    assert cube(env)[2] == pytest.approx(CUBE_HALF + 0.1, abs=1e-3)
    hold = env.scene.actions.join(env.data.ctrl[env.scene.arm_ctrl], 0.04)
    for _ in range(40):
        env.advance(hold)
    assert 0 < cube(env)[2] < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_a_jolt_turns_every_joint_by_at_most_its_size(env: ManipEnv, seed: int):
    before, at = arm(env), cube(env)
    assert jolt_joints(env, np.random.default_rng(seed), 0.2)
    turned = np.abs(arm(env) - before)
    assert turned.min() > 0
    assert turned.max() <= 0.2
    np.testing.assert_array_equal(cube(env), at)
    assert deepest(env) > -0.004


def test_a_held_object_goes_with_the_jolted_hand(env: ManipEnv, drive_until):
    drive_until(env, "carry")
    rotation = env.data.site_xmat[env.scene.ee_site].reshape(3, 3).copy()
    before = rotation.T @ (cube(env) - env.data.site_xpos[env.scene.ee_site])
    assert jolt_joints(env, np.random.default_rng(0), 0.1)
    rotation = env.data.site_xmat[env.scene.ee_site].reshape(3, 3)
    after = rotation.T @ (cube(env) - env.data.site_xpos[env.scene.ee_site])
    np.testing.assert_allclose(after, before, atol=1e-9)


@pytest.mark.parametrize("opening", [0.0, 0.05])
def test_fingers_are_put_where_they_are_wanted(env: ManipEnv, opening: float):
    set_fingers(env, opening)
    gripper = env.scene.gripper
    assert opening_of(env) == pytest.approx(max(opening, gripper.least), abs=1e-6)
    np.testing.assert_allclose(env.data.ctrl[gripper.ctrl], gripper.command(opening))


def test_fingers_do_not_close_through_an_object(env: ManipEnv, drive_until):
    drive_until(env, "grasp")
    before = opening_of(env)
    set_fingers(env, 0.0)
    assert opening_of(env) == before
    assert deepest(env) > -0.004
    np.testing.assert_array_equal(env.data.ctrl[env.scene.gripper.ctrl], env.scene.gripper.command(0.0))


def test_a_scene_without_an_object_has_none_to_knock():
    env = ManipEnv("panda", "reach")
    env.start(SEED)
    before = env.get_state().to_vector().tobytes()
    assert not knock_object(env, np.random.default_rng(0), (0.05, 0.08))
    assert not drop_object(env, np.random.default_rng(0), (0.05, 0.08), 0.1)
    assert env.get_state().to_vector().tobytes() == before


def test_noise_has_the_spread_that_its_share_says(env: ManipEnv):
    actions = env.scene.actions
    rng, action = np.random.default_rng(0), np.linspace(-1, 1, len(actions))
    draws = np.array([noisy(action, env, 0.1, rng) - action for _ in range(4_000)])
    gripper = env.scene.gripper
    expected = 0.1 * actions.join(2 * actions.scale[actions.arm], gripper.most - gripper.least)
    np.testing.assert_allclose(draws.std(axis=0), expected, rtol=0.06)  # five standard errors
    assert np.abs(draws.mean(axis=0) / expected).max() < 0.08


def test_disturbances_are_a_function_of_the_seed(env: ManipEnv):
    def run(seed: int) -> tuple[bytes, list[int]]:
        env.start(SEED)
        disturber, knocked, seen = Disturber(env, STANDARD, seed), [], b""
        for step in range(26):
            before = cube(env)
            disturber.before(step)
            if not np.array_equal(before, cube(env)):
                knocked.append(step)
            seen += disturber.action(np.zeros(len(env.scene.actions))).tobytes() + cube(env).tobytes()
        return seen, knocked

    first, second = run(1), run(2)
    assert first == run(1)
    assert first[0] != second[0]
    for _, knocked in (first, second):
        assert len(knocked) == 1
        assert 5 <= knocked[0] < 25


def test_without_noise_the_action_is_not_touched(env: ManipEnv):
    action = np.zeros(len(env.scene.actions))
    assert Disturber(env, Disturbance(knock=(0.05, 0.08)), 1).action(action) is action


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_noise_out_of_range_is_refused(share: float):
    with pytest.raises(UsageError, match=str(share)):
        Disturbance(action_noise=share)
