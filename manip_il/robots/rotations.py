"""Rotations of a hand: matrices from and to rotation vectors and yaws, and angles between them."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.robot import Robot


def rotation_vector(rotation: F64) -> F64:
    """Return the rotation vector (3,), axis times angle [rad], at most pi long, of a rotation matrix (3, 3)."""
    quaternion, vector = np.empty(4), np.empty(3)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector


def rotation_matrix(vector: F64) -> F64:
    """Return the rotation (3, 3) about an axis by an angle, given as their product (3,) [rad]."""
    quaternion, matrix = np.array([1.0, 0.0, 0.0, 0.0]), np.empty(9)
    mujoco.mju_quatIntegrate(quaternion, vector, 1.0)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def hand_down(yaw: float) -> F64:
    """Return the rotation of `ee` with the hand pointing down, turned by `yaw` [rad] about the world's z; (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def turn_about_z(yaw: float) -> F64:
    """Return the rotation (3, 3) about the world's z by `yaw` [rad]."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_ahead(robot: Robot, shoulder: F64, position: F64) -> float:
    """Return the world yaw [rad] that counts as zero for a hand at `position`; shoulder, position: (3,) [m]."""
    return math.atan2(position[1] - shoulder[1], position[0] - shoulder[0]) if robot.faces_ahead else 0.0


def angle_ahead(rotation: F64) -> float:
    """Return the yaw of the x axis of a rotation (3, 3) [rad]."""
    return math.atan2(rotation[1, 0], rotation[0, 0])


def angle_across(rotation: F64) -> float:
    """Return the yaw [rad] of a hand (3, 3), which may lean, from the direction in which its fingers move."""
    return math.atan2(rotation[0, 1], -rotation[1, 1])


def off_yaw(rotation: F64, yaw: float) -> float:
    """Return the angle [rad] between `yaw` and the yaw of a hand (3, 3), as in `angle_across`."""
    return abs(math.remainder(angle_across(rotation) - yaw, 2 * math.pi))


def angle_off_vertical(rotation: F64) -> float:
    """Return the angle [rad] by which a hand (3, 3) leans from pointing down."""
    return math.acos(min(1.0, max(-1.0, -float(rotation[2, 2]))))


def angle_from_down(rotation: F64, yaw: float) -> float:
    """Return the angle [rad] between a rotation (3, 3) and `hand_down(yaw)`."""
    (xx, xy, _), (yx, yy, _), (_, _, zz) = rotation.tolist()
    trace = math.cos(yaw) * (xx - yy) + math.sin(yaw) * (xy + yx) - zz
    return math.acos(min(1.0, max(-1.0, (trace - 1) / 2)))


def angle_between(a: F64, b: F64) -> float:
    """Return the angle of the rotation from `a` to `b`, (3, 3) each [rad]."""
    return math.acos(min(1.0, max(-1.0, (float(a.ravel().dot(b.ravel())) - 1) / 2)))


def turned_towards(rotation: F64, target: F64, largest: float) -> F64:
    """Return `rotation` (3, 3) turned towards `target` along the shortest path, by at most `largest` [rad]."""
    if angle_between(rotation, target) <= largest:
        return target
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = rotation.T.dot(target).tolist()
    axis = zy - yz, xz - zx, yx - xy
    length = math.hypot(*axis)
    if length < 1e-6:  # half a turn, for which this axis is 0: turn about the hand's z
        axis, length = (0.0, 0.0, 1.0), 1.0
    x, y, z = axis
    turn = largest / length
    return rotation.dot(rotation_matrix(np.array([turn * x, turn * y, turn * z])))
