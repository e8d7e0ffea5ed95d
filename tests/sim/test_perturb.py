"""A perturbation happens once, at its step, as its kind says; one that changes nothing leaves no trace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from manip_il.engine.jobs import RolloutJob
from manip_il.errors import UnknownName, UsageError
from manip_il.robots.robot import ROBOTS
from manip_il.sim.disturb import Disturbance
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.perturb import DROP, JOLT, KINDS, SHIFT, Perturbation, Perturber, kinds_for
from manip_il.tasks.objects import CUBE_HALF
from manip_il.tasks.table import TASKS

SEED, MOMENT = 5_000_000, 7
CHANGES = [name for name, kind in KINDS.items() if kind.change is not None]
WRONG = [name for name, kind in KINDS.items() if kind.wrong is not None]


@pytest.fixture(params=list(ROBOTS))
def env(request) -> ManipEnv:
    env = ManipEnv(request.param)
    env.start(SEED)
    return env


def perturber(env: ManipEnv, kind: str, seed: int = SEED) -> Perturber:
    return Perturber(env, Perturbation(kind, {seed: MOMENT}), seed)


def bits(env: ManipEnv) -> bytes:
    return env.get_state().to_vector().tobytes()


def arm(env: ManipEnv) -> np.ndarray:
    return env.data.qpos[env.scene.arm_q].copy()


def cube(env: ManipEnv) -> np.ndarray:
    return env.data.joint("object").qpos[:3].copy()


def wrong(env: ManipEnv, kind: str, action: np.ndarray, seed: int = SEED) -> np.ndarray:
    one = perturber(env, kind, seed)
    one.before(MOMENT)
    return one.action(action)


@pytest.mark.parametrize("kind", KINDS)
def test_it_happens_at_its_step_alone(env: ManipEnv, kind: str):
    one, action = perturber(env, kind), env.scene.actions.join(arm(env), 0.0)
    touched = []
    for step in range(MOMENT + 5):
        env.set_state(replace(env.get_state(), streak=2))
        gripper = env.scene.gripper
        env.data.qpos[gripper.q] = gripper.command(0.03)  # neither open nor closed
        before = bits(env)
        one.before(step)
        if bits(env) != before or one.action(action) is not action:
            touched.append(step)
    assert touched == [MOMENT]


@pytest.mark.parametrize("seed", range(SEED, SEED + 4))
def test_the_world_is_changed_by_as_much_as_the_kind_says(env: ManipEnv, seed: int):
    def changed(kind: str) -> tuple[np.ndarray, np.ndarray, float]:
        env.start(seed)
        q, at = arm(env), cube(env)
        perturber(env, kind, seed).before(MOMENT)
        return arm(env) - q, cube(env) - at, float(env.observe().state[env.scene.actions.gripper])

    turned, _, _ = changed("jolt")
    assert 0 < np.abs(turned).max() <= JOLT
    _, moved, _ = changed("moved")
    assert 0 < np.hypot(*moved[:2]) <= SHIFT[1]
    _, dropped, _ = changed("dropped")
    assert np.hypot(*dropped[:2]) <= SHIFT[1]
    assert dropped[2] == pytest.approx(DROP, abs=CUBE_HALF / 10)
    least, most = env.scene.gripper.least, env.scene.gripper.most
    assert changed("closed")[2] == pytest.approx(max(0.0, least), abs=1e-6)
    assert changed("open")[2] == pytest.approx(most, abs=1e-6)


def test_what_changes_nothing_leaves_the_state_bit_for_bit(env: ManipEnv, drive_until):
    drive_until(env, "descend")  # with open fingers
    env.set_state(replace(env.get_state(), streak=3))
    before = bits(env)
    perturber(env, "open").before(MOMENT)
    assert bits(env) == before
    perturber(env, "closed").before(MOMENT)
    assert bits(env) != before
    assert env.get_state().streak == 0


def test_a_random_action_is_any_that_a_learner_may_choose(env: ManipEnv):
    actions, gripper, q = env.scene.actions, env.scene.gripper, arm(env)
    drawn = np.array([wrong(env, "random", np.zeros(len(actions)), seed) for seed in range(200)])
    steps, openings = drawn[:, actions.arm] - q, drawn[:, actions.gripper]
    longest, room = env.scene.robot.max_joint_step, gripper.most - gripper.least
    assert np.abs(steps).max() <= longest
    assert np.abs(steps).max() > 0.95 * longest
    assert gripper.least <= openings.min() < gripper.least + 0.05 * room
    assert gripper.most - 0.05 * room < openings.max() <= gripper.most


@pytest.mark.parametrize(("command", "opposite"), [(0.0, 1.0), (0.4, 1.0), (0.6, 0.0), (1.0, 0.0)])
def test_opposite_actions_mirror_the_step_and_turn_the_gripper_round(env: ManipEnv, command: float, opposite: float):
    q, actions, gripper = arm(env), env.scene.actions, env.scene.gripper
    step = np.linspace(-0.1, 0.1, len(q))

    def at(share: float) -> float:
        return gripper.least + share * (gripper.most - gripper.least)

    action = actions.join(q + step, at(command))
    mirrored, other = actions.join(q - step, at(opposite)), actions.join(q + step, at(opposite))
    np.testing.assert_allclose(wrong(env, "opposite", action), mirrored, atol=1e-12)
    np.testing.assert_allclose(wrong(env, "gripper", action), other, atol=1e-15)


@pytest.mark.parametrize("kind", ["jolt", "moved", "dropped", "random"])
def test_what_is_drawn_follows_from_the_seed(env: ManipEnv, kind: str):
    def outcome(seed: int) -> bytes:
        env.start(SEED)
        one = perturber(env, kind, seed)
        one.before(MOMENT)
        return bits(env) + one.action(np.zeros(len(env.scene.actions))).tobytes()

    assert outcome(1) == outcome(1)
    assert outcome(1) != outcome(2)


def test_without_an_object_neither_it_nor_the_gripper_matters():
    assert list(kinds_for(TASKS["reach"])) == ["jolt", "random", "opposite"]
    assert kinds_for(TASKS["lift"]) == kinds_for(TASKS["pick_place"]) == KINDS


def test_a_perturbation_that_cannot_be_is_refused():
    with pytest.raises(UnknownName, match="did you mean 'jolt'"):
        Perturbation("jolts", {})
    with pytest.raises(UsageError, match="step -1"):
        Perturbation("jolt", {1: 3, 2: -1})
    env = ManipEnv("panda", "reach")
    with pytest.raises(UsageError, match="'moved' needs an object; reach has none"):
        perturber(env, "moved")
    with pytest.raises(UsageError, match="no moment for seed 2"):
        Perturber(env, Perturbation("jolt", {1: 3}), 2)
    with pytest.raises(UsageError, match="not both"):
        RolloutJob(EnvConfig(), "expert", disturbance=Disturbance(0.1), perturbation=Perturbation("jolt", {}))


def test_every_kind_changes_the_world_or_an_action():
    assert sorted(CHANGES + WRONG) == sorted(KINDS)
