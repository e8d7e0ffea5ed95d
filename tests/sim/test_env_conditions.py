"""Environments under conditions: physics has the drawn cube, observations and pictures what was drawn for them."""

from __future__ import annotations

import numpy as np
import pytest

from manip_il.expert import Expert
from manip_il.sim.conditions import NOMINAL, Condition
from manip_il.sim.env import EnvConfig, ManipEnv, environment_state_names
from manip_il.sim.scene import build_scene

FETCH = EnvConfig("fetch")
HEAVY = Condition("heavy", mass=(0.3, 0.3), size=(0.06, 0.06), friction=(0.7, 0.7))
LATE = Condition("late", delay=(3, 3))
ANY_COLOUR = Condition("any", colour=(0, 1))
NOISY = Condition("noisy", joint_noise=(0.01, 0.01), position_noise=(0.02, 0.02))


def drive(env: ManipEnv, steps: int) -> list[tuple[bytes, np.ndarray, np.ndarray]]:
    """Under the expert: physics, and what a policy is shown, step by step."""
    expert, path = Expert(build_scene(env.config.robot, env.config.task)), []
    for _ in range(steps):
        seen, state = env.observe(), env.get_state()
        path.append((state.physics.tobytes(), seen.state, seen.environment_state))
        env.advance(expert.label(state).action)
    return path


def names(env: ManipEnv, thing: str) -> list[int]:
    known = environment_state_names(env.scene)
    return [known.index(f"{thing}.{axis}") for axis in "xyz"]


def test_a_nominal_episode_is_the_plain_environments_to_the_bit():
    plain, other = ManipEnv(config=FETCH), ManipEnv(conditions=[HEAVY, NOMINAL], config=FETCH)
    for seed in (2, 3, 5):  # 2 leaves another cube behind
        plain.start(seed)
        other.start(seed)
        paths = drive(plain, 15), drive(other, 15)
        same = all(
            a[0] == b[0] and np.array_equal(a[1], b[1]) and np.array_equal(a[2], b[2])
            for a, b in zip(*paths, strict=True)
        )
        assert same == (seed % 2 == 1)


def test_the_cube_has_the_drawn_mass_size_and_friction():
    env = ManipEnv(conditions=[HEAVY], config=FETCH)
    env.start(0)
    model, q = env.world.model, env.scene.objects["object"].q
    assert model.body("object").mass == pytest.approx(0.3)
    assert model.geom("object").size == pytest.approx([0.03] * 3)
    assert env.data.qpos[q + 2] == 0.03
    assert model.geom("object").friction[0] == 0.7


def test_a_late_policy_sees_the_world_three_steps_ago():
    plain, late = ManipEnv(config=FETCH), ManipEnv(conditions=[LATE], config=FETCH)
    plain.start(4)
    late.start(4)
    now, then = drive(plain, 10), drive(late, 10)
    assert [one[0] for one in now] == [one[0] for one in then]  # the true state is not late
    for step in range(10):
        assert np.array_equal(then[step][1], now[max(0, step - 3)][1])
        assert np.array_equal(then[step][2], now[max(0, step - 3)][2])
    late.start(4)
    assert np.array_equal(drive(late, 1)[0][1], now[0][1])  # nothing is left of the episode before


def test_noise_is_on_joints_and_object_and_all_that_follows_from_them():
    plain, noisy = ManipEnv(config=FETCH), ManipEnv(conditions=[NOISY], config=FETCH)
    joints, cubes = [], []
    arm, gripper = plain.scene.actions.arm, plain.scene.actions.gripper
    for seed in range(8):
        plain.start(seed)
        noisy.start(seed)
        for true, shown in zip(drive(plain, 20), drive(noisy, 20), strict=True):
            assert true[0] == shown[0]
            joints.append((shown[1] - true[1])[arm])
            assert shown[1][gripper] == true[1][gripper]  # the gripper's opening has none
            ee, cube, apart = (shown[2][names(noisy, thing)] for thing in ("ee", "object", "object_from_ee"))
            cubes.append(cube - true[2][names(noisy, "object")])
            assert np.allclose(apart, cube - ee, atol=1e-6)
            assert np.array_equal(shown[2][names(noisy, "goal")], true[2][names(noisy, "goal")])
            assert not np.array_equal(ee, true[2][names(noisy, "ee")])
    assert np.std(joints) == pytest.approx(0.01, rel=0.1)
    assert np.std(cubes) == pytest.approx(0.02, rel=0.1)


def test_the_same_seed_is_shown_the_same_noise():
    env = ManipEnv(conditions=[NOISY, LATE], config=FETCH)
    env.start(6)
    first = drive(env, 5)
    env.start(7)
    drive(env, 2)
    env.start(6)
    for a, b in zip(first, drive(env, 5), strict=True):
        assert a[0] == b[0]
        assert np.array_equal(a[1], b[1])
        assert np.array_equal(a[2], b[2])


def test_a_task_without_an_object_can_be_late_and_noisy():
    env = ManipEnv(conditions=[NOISY, LATE], config=EnvConfig("fetch", "reach"))
    for seed in (0, 1):
        env.start(seed)
        assert len(drive(env, 5)) == 5


@pytest.mark.gl
def test_pictures_show_the_episodes_own_look_and_plain_ones_after_it():
    look = Condition("look", colour=(0.1, 0.9), size=(0.06, 0.06), camera_shift=(0.05, 0.05), brightness=(0.5, 0.7))
    settings = {"config": FETCH, "cameras": ("front", "wrist"), "image_size": (32, 32)}
    plain, other = ManipEnv(**settings), ManipEnv(conditions=[look, NOMINAL], **settings)
    for seed in (0, 1, 2, 3):
        plain.start(seed)
        other.start(seed)
        ours, theirs = other.observe().images, plain.observe().images
        for camera in ours:
            assert np.array_equal(ours[camera], theirs[camera]) == (seed % 2 == 1)
        if seed % 2 == 0:
            assert ours["front"].mean() < 0.85 * theirs["front"].mean()


@pytest.mark.gl
def test_the_drawn_colour_is_the_cubes():
    settings = {"config": FETCH, "cameras": ("wrist",), "image_size": (64, 64)}
    blue = ManipEnv(conditions=[ANY_COLOUR], **settings)
    seed = next(s for s in range(200) if _is_blue(ANY_COLOUR.draw(s).values["colour"]))
    plain = ManipEnv(**settings)
    for env in (blue, plain):
        env.start(seed)
    ours, theirs = (env.observe().images["wrist"].astype(int) for env in (blue, plain))
    red = (theirs[..., 0] > 1.7 * theirs[..., 1]) & (theirs[..., 0] > 1.7 * theirs[..., 2])
    assert red.sum() > 10
    assert (ours[red][:, 2] > ours[red][:, 0]).mean() > 0.8


def _is_blue(colour: list[float]) -> bool:
    return colour[2] > 0.6 and max(colour[:2]) < 0.3
