"""Environments under conditions: physics has the drawn cube, observations and pictures what was
drawn for them.
"""

from typing import Any

import numpy as np
import pytest

from manip_il import Expert
from manip_il.sim.conditions import NOMINAL, Condition
from manip_il.sim.env import ManipEnv, environment_state_names
from manip_il.worlds.ladder.world import make_env

from ..tables import every_robot, every_scene, every_scene_with_a_cube

HEAVY = Condition("heavy", mass=(0.3, 0.3), size=(0.06, 0.06), friction=(0.7, 0.7))
LATE = Condition("late", delay=(3, 3))
NOISY = Condition("noisy", joint_noise=(0.01, 0.01), position_noise=(0.02, 0.02))


def drive(env: ManipEnv, seed: int, steps: int) -> list[tuple[bytes, list[float], list[float]]]:
    """An episode under the expert: physics, and what a policy is shown, step by step."""
    expert, path = Expert(env.scene), []
    env.start(seed)
    for _ in range(steps):
        seen, state = env.observe(), env.get_state()
        path.append((state.physics.tobytes(), seen.state.tolist(), seen.environment_state.tolist()))
        env.advance(expert.label(state).action)
    return path


@every_scene_with_a_cube
def test_a_nominal_episode_is_the_plain_environments_to_the_bit(robot: str, task: str):
    plain, other = make_env(robot, task), make_env(robot, task, conditions=[HEAVY, NOMINAL])
    for seed in (2, 3, 5):  # 2 leaves another cube behind
        assert (drive(plain, seed, 15) == drive(other, seed, 15)) == (seed % 2 == 1)


@every_scene
def test_a_late_policy_sees_the_world_three_steps_ago(robot: str, task: str):
    plain, late = make_env(robot, task), make_env(robot, task, conditions=[LATE])
    now, then = drive(plain, 4, 10), drive(late, 4, 10)
    assert [one[0] for one in now] == [one[0] for one in then]  # the true state is not late
    assert [one[1:] for one in then] == [now[max(0, step - 3)][1:] for step in range(10)]
    assert drive(late, 4, 1)[0] == now[0]  # nothing is left of the episode before


@every_robot
def test_noise_is_on_joints_and_object_and_all_that_follows_from_them(robot: str):
    plain, noisy = make_env(robot), make_env(robot, conditions=[NOISY])
    joints, cubes = [], []
    arm, gripper = plain.scene.actions.arm, plain.scene.actions.gripper
    known = environment_state_names(plain.scene)

    def vector(shown: list[float], thing: str) -> np.ndarray:
        return np.array([shown[known.index(f"{thing}.{axis}")] for axis in "xyz"])

    for seed in range(8):
        for (physics, state, seen), (same, off, shown) in zip(
            drive(plain, seed, 20), drive(noisy, seed, 20), strict=True
        ):
            assert physics == same
            joints.append(np.subtract(off, state)[arm])
            assert off[gripper] == state[gripper]  # the gripper's opening has none
            cubes.append(vector(shown, "object") - vector(seen, "object"))
            apart = vector(shown, "object") - vector(shown, "ee")
            assert vector(shown, "object_from_ee") == pytest.approx(apart, abs=1e-6)
            assert np.array_equal(vector(shown, "goal"), vector(seen, "goal"))
            assert not np.array_equal(vector(shown, "ee"), vector(seen, "ee"))
    noise = 0.01 if plain.scene.actions.units is None else np.degrees(0.01)
    assert np.std(joints) == pytest.approx(noise, rel=0.1)
    assert np.std(cubes) == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("other_has_begun", [False, True])
def test_a_restored_state_has_the_same_future_in_any_environment(other_has_begun: bool):
    condition = Condition(
        "all", action_noise=(0.1, 0.1), random_actions=(0.3, 0.3), knock=(0.05, 0.05), knock_step=(6, 6),
        joint_noise=(0.01, 0.01), position_noise=(0.01, 0.01), mass=(0.05, 0.3),
    )  # fmt: skip
    env, other = (make_env("panda", "lift", conditions=[condition, NOMINAL]) for _ in range(2))

    def future(of: ManipEnv) -> list[Any]:
        found: list[Any] = []
        for _ in range(10):
            seen, reward, *_ = of.step(np.zeros(len(of.scene.actions), np.float32))
            found += [
                *(value.tolist() for value in seen.values()),
                reward,
                of.get_state().to_vector().tolist(),
            ]
        return found

    env.reset(seed=4)
    for _ in range(3):
        env.step(np.zeros(len(env.scene.actions), np.float32))
    state = env.get_state()
    first = future(env)
    env.set_state(state)
    assert future(env) == first
    if other_has_begun:
        other.reset(seed=5)
    other.set_state(state)
    assert future(other) == first


def test_a_knock_that_has_happened_does_not_happen_again_in_a_restored_state():
    env = make_env(
        "panda", "lift", conditions=[Condition("knocked", knock=(0.05, 0.05), knock_step=(0, 0))]
    )
    env.reset(seed=0)
    env.observe()
    state = env.get_state()
    env.set_state(state)
    env.observe()
    np.testing.assert_array_equal(env.get_state().physics, state.physics)
