"""A posture to start from: over the workspace, the hand down, far from limits and from singular postures."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UsageError
from manip_il.robots.ik import ArmIK
from manip_il.robots.meeting import Body
from manip_il.robots.parts import EndEffector
from manip_il.robots.robot import Robot
from manip_il.robots.rotations import hand_down, rotation_vector

F64 = NDArray[np.float64]
_STARTS, _STEPS = 40, 150  # of inverse kinematics: random postures, and steps from each
_LONGEST = 0.2  # of a joint in a step [rad]
_HIGHEST = 0.2  # of the hand over the table, or half the workspace's height where that is less [m]
_LOWER = (1.0, 0.7, 0.4)  # shares of that, tried one after the other
_ARRIVED = 0.01  # off the place [m], an angle counting as 5 cm a radian
_ANGLE_AS_LENGTH = 0.05
_ENOUGH = (0.5, 0.15, 0.25)  # of margin to a limit [rad], of the smallest singular value, of height of the links [m]
_DIGITS = 4


def find_home(robot: Robot, turns: bool) -> Robot:
    """Return the robot with its best posture for a hand that points down over the workspace's middle.

    turns: the frame `ee` may be turned by half about z, where that suits the arm better. Raises `UsageError` where the
    hand gets there from none of forty postures.
    """
    halves = (robot, replace(robot, ee=_half_turned(robot.ee))) if turns else (robot,)
    heights = [min(_HIGHEST, robot.workspace.height / 2) * share for share in _LOWER]
    found = (max((_best(one, height) for one in halves), key=lambda one: one[0]) for height in heights)
    best = next((one for one in found if math.isfinite(one[0])), (-math.inf, robot))
    if not math.isfinite(best[0]):
        x, y = robot.workspace.centre
        mount = " gripper.quaternion (how the gripper is put onto the hand)," if robot.gripper.files else ""
        raise UsageError(
            f"robot {robot.name}: the hand does not get over the workspace's centre ({x:g}, {y:g}), pointing down;"
            f" look at workspace.centre,{mount} hand and base, or give home"
        )
    return best[1]


def _half_turned(ee: EndEffector) -> EndEffector:
    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, np.array(ee.quaternion), np.array([0.0, 0.0, 0.0, 1.0]))
    return replace(ee, quaternion=tuple(round(float(value), 6) for value in turned))


def _best(robot: Robot, height: float) -> tuple[float, Robot]:
    """The best posture of one way round of the hand, and how good it is; minus infinity for none."""
    soft = robot.leans
    middle = replace(robot, home=tuple(_middles(robot)))
    ik, body = ArmIK(middle), Body(middle)
    limits = _counted(ik.limits)
    rng = np.random.default_rng(0)
    best = -math.inf, robot
    target = np.array([*robot.workspace.centre, height])
    rotation = hand_down(ik.ahead(target))
    for _ in range(_STARTS):
        q, miss = _descend(ik, rng.uniform(*limits.T), target, rotation, soft)
        if miss < _ARRIVED:
            worth = _worth(ik, q, limits) - body.meeting(q)
            if worth > best[0]:
                best = worth, replace(robot, home=tuple(round(float(value), _DIGITS) for value in q))
    return best


def _middles(robot: Robot) -> F64:
    return _counted(ArmIK(robot).limits).mean(axis=1)


def _counted(limits: F64) -> F64:
    """Limits of joints, those of a whole turn or without any as half a turn to either side, (arm, 2) [rad]."""
    free = ~np.isfinite(limits).all(axis=1) | (limits[:, 1] - limits[:, 0] >= 2 * np.pi - 1e-3)
    return np.where(free[:, None], np.array([-np.pi, np.pi]), limits)


def _descend(ik: ArmIK, q: F64, target: F64, rotation: F64, soft: bool) -> tuple[F64, float]:
    """Joints to which inverse kinematics comes from some, and what it misses the pose by [m]."""
    counted, miss = _counted(ik.limits), math.inf
    for _ in range(_STEPS):
        position, turned = ik.ee_pose(q)
        off = rotation_vector(rotation @ turned.T)
        angle = abs(float(off[2])) if soft else float(np.linalg.norm(off))
        miss = float(np.linalg.norm(target - position)) + _ANGLE_AS_LENGTH * angle
        dq = ik.displacement(target, rotation, _LONGEST)
        if dq is None or np.abs(dq).max() < 1e-4:
            break
        q = q + dq
    free = counted[:, 0] == -np.pi
    q = np.where(free, (q + np.pi) % (2 * np.pi) - np.pi, q)
    return np.clip(q, *ik.limits.T), miss


def _worth(ik: ArmIK, q: F64, limits: F64) -> float:
    """Rate a posture by its margin to the limits, distance from a singular posture, and height of the links."""
    margin = float(np.minimum(q - limits[:, 0], limits[:, 1] - q).min())
    singular = ik.smallest_singular_value(q)
    parts = (margin, singular, ik.lowest_link(q))
    return sum(min(1.0, part / enough) for part, enough in zip(parts, _ENOUGH, strict=True))
