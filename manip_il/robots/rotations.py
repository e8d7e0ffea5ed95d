"""Rotation matrices from and to rotation vectors."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


def rotation_vector(rotation: F64) -> F64:
    """Return axis times angle [rad], at most pi long, of a rotation matrix (3, 3)."""
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
