"""Gains of position control that suit the inertia that a joint moves."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_spec

FREQUENCY = 2 * math.pi * 6.0  # of a joint with its motor as a spring [rad/s]
_DIGITS = 3


def find_gains(robot: Robot) -> tuple[float, ...]:
    """Return kp of each joint [N m/rad]: the joint answers at 6 Hz with what hangs on it at home."""
    model = arm_spec(robot).compile()
    data = mujoco.MjData(model)
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    dofs = [model.joint(name).dofadr[0] for name in robot.joints]
    return tuple(float(f"{FREQUENCY**2 * inertia[dof, dof]:.{_DIGITS}g}") for dof in dofs)
