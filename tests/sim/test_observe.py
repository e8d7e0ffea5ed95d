"""A cube looks the same on every face."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.sim.env import ManipEnv
from manip_il.sim.observe import cube_yaw, environment_state_names

SYMMETRIES = [
    np.diag(signs)[list(order)]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
    if np.linalg.det(np.diag(signs)[list(order)]) > 0
]


def quat_of(rotation: np.ndarray) -> np.ndarray:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return quat


def about(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    quat, matrix = np.empty(4), np.empty(9)
    mujoco.mju_axisAngle2Quat(quat, np.asarray(axis), angle)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def test_a_cube_has_24_rotations():
    assert len(SYMMETRIES) == 24


@given(st.floats(-np.pi, np.pi), st.sampled_from(SYMMETRIES))
def test_a_resting_cubes_yaw_does_not_know_the_face_it_lies_on(yaw: float, symmetry: np.ndarray):
    plain = cube_yaw(quat_of(about((0, 0, 1), yaw)))
    turned = cube_yaw(quat_of(about((0, 0, 1), yaw) @ symmetry))
    assert np.exp(4j * turned[0]) == pytest.approx(np.exp(4j * plain[0]), abs=1e-9)
    assert np.exp(4j * turned[0]) == pytest.approx(np.exp(4j * yaw), abs=1e-9)
    assert turned[1] == pytest.approx(0, abs=1e-6)


@given(st.floats(-np.pi, np.pi), st.floats(0, 2 * np.pi), st.floats(0, 0.3), st.sampled_from(SYMMETRIES))
def test_a_tilted_cubes_tilt_does_not_know_its_face_and_its_yaw_hardly(
    yaw: float, direction: float, tilt: float, symmetry: np.ndarray
):
    rotation = about((np.cos(direction), np.sin(direction), 0.0), tilt) @ about((0, 0, 1), yaw)
    plain, turned = cube_yaw(quat_of(rotation)), cube_yaw(quat_of(rotation @ symmetry))
    assert turned[1] == pytest.approx(plain[1], abs=1e-6)
    assert plain[1] == pytest.approx(tilt, abs=1e-6)
    apart = np.angle(np.exp(4j * (turned[0] - plain[0]))) / 4
    between = 2 * np.arctan(np.cos(tilt))  # two sides, a right angle apart, seen from above at worst
    assert abs(apart) <= np.pi / 2 - between + 1e-6


@given(st.floats(-np.pi, np.pi), st.floats(-1.5, 1.5))
def test_yaw_and_tilt_lie_in_their_ranges(yaw: float, tilt: float):
    seen, off = cube_yaw(quat_of(about((1, 0, 0), tilt) @ about((0, 0, 1), yaw)))
    assert abs(seen) <= np.pi / 4 + 1e-12
    assert 0 <= off <= np.arccos(1 / np.sqrt(3)) + 1e-9


def test_the_numbers_are_what_their_names_say():
    env = ManipEnv("panda", "pick_place")
    env.start(5_000_000)
    values = dict(zip(environment_state_names(env.scene.task), env.observe().environment_state, strict=True))

    def vector(name: str) -> np.ndarray:
        return np.array([values[f"{name}.{axis}"] for axis in "xyz"])

    np.testing.assert_allclose(vector("ee"), env.data.site_xpos[env.scene.ee_site], atol=1e-6)
    np.testing.assert_allclose(vector("goal"), env.get_state().goal, atol=1e-6)
    np.testing.assert_allclose(vector("object_from_ee"), vector("object") - vector("ee"), atol=1e-6)
    np.testing.assert_allclose(vector("goal_from_object"), vector("goal") - vector("object"), atol=1e-6)
    assert np.hypot(values["object.cos4yaw"], values["object.sin4yaw"]) == pytest.approx(1, abs=1e-6)
    axes = env.data.site_xmat[env.scene.ee_site].reshape(3, 3)
    for column, axis in ((1, "y"), (2, "z")):
        seen = [values[f"ee.r{row}{axis}"] for row in "xyz"]
        np.testing.assert_allclose(seen, axes[:, column], atol=1e-6)
