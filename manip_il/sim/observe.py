"""`environment_state`: where hand, object and goal are, as named numbers for state-based learners."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.scene import Scene
from manip_il.sim.task import Task

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


def environment_state_names(task: Task) -> tuple[str, ...]:
    """Names of the vector's k entries; lengths in [m], `r` entries of a rotation matrix."""
    names = [*_xyz("ee"), *(f"ee.r{row}{column}" for column in "yz" for row in "xyz"), *_xyz("goal")]
    if not task.has_object:
        return (*names, *_xyz("goal_from_ee"))
    return (
        *names,
        *_xyz("object"),
        "object.cos4yaw",
        "object.sin4yaw",
        "object.tilt",
        *_xyz("object_from_ee"),
        *_xyz("goal_from_object"),
    )


def environment_state(scene: Scene, data: mujoco.MjData, goal: F64) -> F32:
    """The vector, float32 (k,); needs kinematics to be up to date in `data`."""
    ee = data.site_xpos[scene.ee_site]
    rotation = data.site_xmat[scene.ee_site].reshape(3, 3)
    axes = rotation[:, 1:].T.ravel()  # the hand's y and z axes
    if scene.object_q is None:
        return np.concatenate([ee, axes, goal, goal - ee]).astype(np.float32)
    position = data.qpos[scene.object_q : scene.object_q + 3]
    quat = data.qpos[scene.object_q + 3 : scene.object_q + 7]
    yaw, tilt = cube_yaw(quat)
    turn = [np.cos(4 * yaw), np.sin(4 * yaw), tilt]
    parts = [ee, axes, goal, position, turn, position - ee, goal - position]
    return np.concatenate(parts).astype(np.float32)


def cube_yaw(quat: F64) -> tuple[float, float]:
    """A resting cube's yaw modulo a quarter turn, in [-pi/4, pi/4], and its tilt off a face [rad].

    A cube looks the same on every face, so the yaw is that of the side most along x or y once the axis
    nearest the vertical is set aside. quat: wxyz, (4,).
    """
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    rotation = matrix.reshape(3, 3)
    up = int(np.argmax(np.abs(rotation[2])))
    side = (up + 1) % 3
    quarter = math.pi / 2
    yaw = math.atan2(rotation[1, side], rotation[0, side])
    yaw -= quarter * round(yaw / quarter)
    return yaw, math.acos(min(1.0, abs(rotation[2, up])))


def _xyz(name: str) -> tuple[str, str, str]:
    return f"{name}.x", f"{name}.y", f"{name}.z"
