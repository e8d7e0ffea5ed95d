"""The hand's frame `ee`, from where the fingers meet."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UsageError
from manip_il.robots.geometry import at_tip, nearest, outline
from manip_il.robots.gripper import finger_geoms
from manip_il.robots.parts import EndEffector
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_spec

F64 = NDArray[np.float64]
_AT_OBJECT = 0.7  # of the way from closed to open: fingers that turn then stand as they do at an object
_SETTLE, _STEP = 1000, 0.002  # physics steps, and their length [s]
FROM_TIP = 0.012  # of the frame, from the fingertips [m]
_CLEAR = 0.006  # of the fingertips over the table at the frame's lowest [m]
_SQUARE = 0.95  # cosine of how far the fingers' way may be off an axis of the hand's body to count as along it
_LEAST_GAP = 1e-4  # between fingers half closed [m]
_METRES, _TURN = 4, 6  # digits


def find_ee(robot: Robot) -> EndEffector:
    """Return the frame between the fingertips: z from the hand to them, y along the way that the fingers come together.

    Along axes of the hand's body, where that is nearly so. Raises `UsageError` where the fingers do not come apart.
    """
    model, data = _settled(robot, _AT_OBJECT)
    hand = model.body(robot.hand).id
    origin, axes = data.xpos[hand], data.xmat[hand].reshape(3, 3)
    fingers = finger_geoms(model, robot.gripper.fingers)
    middle = np.mean([data.geom_xpos[geom] for finger in fingers for geom in finger], axis=0)
    z = _along_axis(axes.T @ (middle - origin))
    points = {geom: (outline(model, data, geom) - origin) @ axes for finger in fingers for geom in finger}
    tip = max(float((points[geom] @ z).max()) for geom in points)
    pads, ends = nearest(model, data, [at_tip(model, data, finger, axes @ z) for finger in fingers])
    one, other = (ends - origin) @ axes
    way = other - one - z * (z @ (other - one))
    if np.linalg.norm(way) < _LEAST_GAP:
        raise UsageError(f"robot {robot.name}: the fingers do not come apart; look at gripper.fingers and gripper.open")
    y = _along_axis(way / np.linalg.norm(way), _SQUARE)
    x = np.cross(y, z)
    low, high = (max((points[pad] @ x).min() for pad in pads), min((points[pad] @ x).max() for pad in pads))
    position = x * (low + high) / 2 + y * (y @ (one + other)) / 2 + z * (tip - FROM_TIP)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([x, y, z], axis=1).ravel())
    return EndEffector(
        robot.hand,
        tuple(round(float(value), _METRES) for value in position),
        tuple(round(float(value), _TURN) for value in quaternion),
        round(FROM_TIP + max(0.0, _tip(robot, z) - tip) + _CLEAR, _METRES),
    )


def _settled(robot: Robot, share: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The robot with its arm as the model has it, and its fingers at rest at a share of the way from closed to open."""
    alone = replace(robot, joints=(), home=(), gains=(), forces=(), armature=())
    spec = arm_spec(alone)
    spec.option.timestep, spec.option.integrator = _STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    data, config = mujoco.MjData(model), robot.gripper
    for name, closed, opened in zip(config.joints, config.closed, config.open, strict=True):
        data.joint(name).qpos[0] = data.actuator(name).ctrl[0] = closed + share * (opened - closed)
    mujoco.mj_step(model, data, _SETTLE)
    mujoco.mj_kinematics(model, data)
    return model, data


def _tip(robot: Robot, z: F64) -> float:
    """Measure how far the closed fingers go from the hand along its axis (3,) [m]."""
    model, data = _settled(robot, 0.0)
    hand = model.body(robot.hand).id
    along = data.xmat[hand].reshape(3, 3) @ z
    geoms = [geom for finger in finger_geoms(model, robot.gripper.fingers) for geom in finger]
    return max(float(((outline(model, data, geom) - data.xpos[hand]) @ along).max()) for geom in geoms)


def _along_axis(vector: F64, least: float = 0.0) -> F64:
    """The unit vector along the axis that a vector is most along, (3,); the vector where its share is below `least`."""
    axis = int(np.argmax(np.abs(vector)))
    if abs(float(vector[axis])) < least:
        return vector
    unit = np.zeros(3)
    unit[axis] = np.sign(vector[axis])
    return unit
