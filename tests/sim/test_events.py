"""Events change what they say by what they say, once, and leave a world that can be."""

import mujoco
import numpy as np
import pytest

from manip_il.sim.conditions import Condition
from manip_il.sim.env import ManipEnv
from manip_il.sim.events import KINDS, Events, move_object
from manip_il.tasks.objects import CUBE_HALF

from ..scenes import SEED, bits, cube, drive_until, started, still
from ..tables import WITH_A_CUBE

MOMENT = 7


@pytest.fixture(params=WITH_A_CUBE, ids="-".join)
def env(request) -> ManipEnv:
    return started(*request.param)


def arm(env: ManipEnv) -> np.ndarray:
    return env.data.qpos[env.scene.arm_q].copy()


def opening(env: ManipEnv) -> float:
    return env.world.opening


def deepest(env: ManipEnv) -> float:
    mujoco.mj_forward(env.world.model, env.data)
    return min((contact.dist for contact in env.data.contact), default=0.0)


def events(env: ManipEnv, kind: str, seed: int = SEED) -> Events:
    return Events(env.world, {kind: MOMENT}, seed)


@pytest.mark.parametrize("seed", range(5))
def test_a_knock_moves_the_object_alone_and_by_its_distance(env: ManipEnv, seed: int):
    before, q = cube(env), arm(env)
    move_object(env.world, np.random.default_rng(seed), (0.05, 0.08))
    moved = cube(env) - before
    assert 0.05 <= np.hypot(*moved[:2]) <= 0.08
    assert cube(env)[2] == pytest.approx(CUBE_HALF, abs=1e-3)
    assert env.world.reach.has(cube(env))
    np.testing.assert_array_equal(arm(env), q)
    assert deepest(env) > -0.004


def test_a_share_of_the_actions_is_random_and_the_others_are_as_they_were(env: ManipEnv):
    drawn = Condition("random", random_actions=(0.3, 0.3)).draw(SEED)
    action, two = still(env, 0.04), [Events(env.world, drawn, SEED) for _ in range(2)]
    executed = [[one.action(action, step) for step in range(400)] for one in two]
    np.testing.assert_array_equal(*executed)
    changed = [not np.array_equal(one, action) for one in executed[0]]
    assert 0.2 < np.mean(changed) < 0.4
    actions = env.scene.actions
    beyond = (
        np.abs(np.array(executed[0]) - env.observe().state)[:, actions.arm]
        - actions.scale[actions.arm]
    )
    assert beyond.max() < 1e-6


@pytest.mark.parametrize("kind", KINDS)
def test_a_perturbation_happens_at_its_step_alone(env: ManipEnv, kind: str):
    one, action = events(env, kind), env.scene.actions.join(arm(env), 0.0)
    touched = []
    for step in range(MOMENT + 5):
        gripper = env.scene.gripper
        env.data.qpos[gripper.q] = gripper.command(0.03)  # neither open nor closed
        before = bits(env)
        changed = one.before(step)
        assert changed == (bits(env) != before)
        if changed or one.action(action, step) is not action:
            touched.append(step)
    assert touched == [MOMENT]


@pytest.mark.parametrize("seed", range(SEED, SEED + 4))
def test_the_world_is_changed_by_as_much_as_the_kind_says(env: ManipEnv, seed: int):
    def changed(kind: str) -> tuple[np.ndarray, np.ndarray, float]:
        env.start(seed)
        q, at = arm(env), cube(env)
        events(env, kind, seed).before(MOMENT)
        return arm(env) - q, cube(env) - at, opening(env)

    turned, moved, _ = changed("jolt")
    assert 0 < np.abs(turned).min() <= np.abs(turned).max() <= 0.2
    np.testing.assert_array_equal(moved, 0)
    assert deepest(env) > -0.004
    _, dropped, _ = changed("dropped")
    assert 0 < np.hypot(*dropped[:2]) <= 0.1
    assert dropped[2] == pytest.approx(0.1, abs=CUBE_HALF / 10)
    assert changed("open")[2] == pytest.approx(env.scene.gripper.most, abs=1e-6)


def test_an_object_in_the_hand_of_a_jolted_arm_stays_behind(env: ManipEnv):
    drive_until(env, "carry")
    before, at = arm(env), cube(env)
    assert events(env, "jolt").before(MOMENT)
    assert np.abs(arm(env) - before).max() > 0.02
    np.testing.assert_array_equal(cube(env), at)
    assert deepest(env) > -0.004
