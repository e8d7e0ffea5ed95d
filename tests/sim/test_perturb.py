"""A perturbation happens once, at its step, as its kind says; one that changes nothing leaves no trace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from manip_il.engine.jobs import RolloutJob
from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import Phase
from manip_il.sim.disturb import Disturbance
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.perturb import DROP, JOLT, KINDS, SHIFT, Perturbation, Perturber, kinds_for
from manip_il.sim.task import TASKS
from manip_il.sim.world import CUBE_HALF_SIZE

SEED, MOMENT = 5_000_000, 7
CHANGES = [name for name, kind in KINDS.items() if kind.change is not None]
WRONG = [name for name, kind in KINDS.items() if kind.wrong is not None]


@pytest.fixture(params=["panda", "fetch"])
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
    one, action = perturber(env, kind), np.append(arm(env), 0.0)
    touched = []
    for step in range(MOMENT + 5):
        env.set_state(replace(env.get_state(), streak=2))
        env.data.qpos[env.scene.finger_q] = 0.01  # neither open nor closed
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
        return arm(env) - q, cube(env) - at, float(env.observe().state[-1])

    turned, _, _ = changed("jolt")
    assert 0 < np.abs(turned).max() <= JOLT
    _, moved, _ = changed("moved")
    assert 0 < np.hypot(*moved[:2]) <= SHIFT[1]
    _, dropped, _ = changed("dropped")
    assert np.hypot(*dropped[:2]) <= SHIFT[1]
    assert dropped[2] == pytest.approx(DROP, abs=CUBE_HALF_SIZE / 10)
    assert changed("closed")[2] == pytest.approx(0.0, abs=1e-6)
    assert changed("open")[2] == pytest.approx(env.scene.robot.max_opening, abs=1e-6)


def test_what_changes_nothing_leaves_the_state_bit_for_bit(env: ManipEnv, drive_until):
    drive_until(env, Phase.DESCEND)  # with open fingers
    env.set_state(replace(env.get_state(), streak=3))
    before = bits(env)
    perturber(env, "open").before(MOMENT)
    assert bits(env) == before
    perturber(env, "closed").before(MOMENT)
    assert bits(env) != before
    assert env.get_state().streak == 0


def test_a_random_action_is_any_that_a_learner_may_choose(env: ManipEnv):
    robot, q = env.scene.robot, arm(env)
    drawn = np.array([wrong(env, "random", np.zeros(8), seed) for seed in range(200)])
    steps, openings = drawn[:, :-1] - q, drawn[:, -1]
    assert np.abs(steps).max() <= robot.max_joint_step
    assert np.abs(steps).max() > 0.95 * robot.max_joint_step
    assert 0 <= openings.min() < 0.05 * robot.max_opening
    assert 0.95 * robot.max_opening < openings.max() <= robot.max_opening


@pytest.mark.parametrize(("command", "opposite"), [(0.0, 1.0), (0.4, 1.0), (0.6, 0.0), (1.0, 0.0)])
def test_opposite_actions_mirror_the_step_and_turn_the_gripper_round(env: ManipEnv, command: float, opposite: float):
    q, largest = arm(env), env.scene.robot.max_opening
    step = np.linspace(-0.1, 0.1, len(q))
    action = np.append(q + step, command * largest)
    np.testing.assert_allclose(wrong(env, "opposite", action), np.append(q - step, opposite * largest), atol=1e-12)
    np.testing.assert_array_equal(wrong(env, "gripper", action), np.append(q + step, opposite * largest))


@pytest.mark.parametrize("kind", ["jolt", "moved", "dropped", "random"])
def test_what_is_drawn_follows_from_the_seed(env: ManipEnv, kind: str):
    def outcome(seed: int) -> bytes:
        env.start(SEED)
        one = perturber(env, kind, seed)
        one.before(MOMENT)
        return bits(env) + one.action(np.zeros(8)).tobytes()

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
