"""Pick and place as a ladder of named geometric predicates and the pose that each rung aims for.

Pure functions of one `Geometry`. Within a rung targets are continuous in the state, and the approach is one
funnel rather than waypoints: the nearer the hand is to being over the object, the lower it may go. Labels of
neighbouring states are then neighbours, which is what a learner can fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.mdp import Phase
from manip_il.sim.world import CUBE_HALF_SIZE

F64 = NDArray[np.float64]

HOVER = 0.08  # of the hand over the object while it is not above it [m]
CLEAR = 0.055  # of the hand over the object: the fingertips are above its top [m]
FUNNEL_RADIUS = 0.010  # misalignment at which the hand may be all the way down [m]
FUNNEL_SLOPE = 2.0  # height the hand gains per misalignment beyond it
ANGLE_AS_LENGTH = 0.05  # how much misalignment a radian of wrong orientation counts for [m/rad]
ANGLE_FREE = 0.1  # orientation error that counts for nothing [rad]
RISE_FIRST = 0.03  # this far under the funnel, the hand only rises [m]
LOWEST_EE = 0.018  # of the ee site over the table: the fingertips just clear it [m]
AT_GRASP = (0.015, 0.015, 0.015)  # object's centre in the ee frame, x y z: start to close [m]
AT_GRASP_ANGLE = 0.3  # [rad]
CLOSING = (0.022, 0.015, 0.022)  # the same once they have begun to close [m]
IN_HAND = (0.034, 0.020, 0.036)  # object's centre in the ee frame, x y z: what closed fingers touch, they hold [m]
GRIP_SLACK = (0.006, 0.003)  # opening below and above the cube's width that is a grip [m]
OPEN_SLACK = 0.016  # opening beyond the cube's width at which the hand may descend [m]
PREFER_ZERO = 0.3  # weight of a grasp's own yaw against its distance from the hand's
MAX_TILT = 0.3  # of the object off a face: wait over it until it has settled [rad]
CARRY_LIFT = 0.05  # of the object over the goal's height on the way there [m]
CARRY_SLOPE = 0.6  # lift per horizontal distance still to go
CARRY_FREE = 0.015  # horizontal distance at which no lift is left [m]
AT_GOAL = 0.01  # [m]
CUBE_WIDTH = 2 * CUBE_HALF_SIZE  # [m]


@dataclass(frozen=True, slots=True)
class Geometry:
    """Where things are. ee_rotation: of `ee` in the world, (3, 3); width: opening as the pads touch the cube [m]."""

    ee: F64
    ee_rotation: F64
    opening: float
    goal: F64
    max_opening: float
    width: float
    object: F64 | None = None
    object_yaw: float = 0.0
    object_tilt: float = 0.0


@dataclass(frozen=True, slots=True)
class Target:
    """What a rung aims for: pose of `ee` in the world and gripper opening command [m]."""

    phase: Phase
    position: F64
    rotation: F64
    opening: float


def choose(g: Geometry) -> Target:
    """The rung that holds, latest first, and its target."""
    if g.object is None:
        return _reach(g)
    offset = object_in_hand(g)
    if grasped(g, offset):
        return _carry(g)
    rotation = hand_down(grasp_yaw(g))
    angle = angle_between(g.ee_rotation, rotation)
    at = np.array([g.object[0], g.object[1], max(g.object[2], LOWEST_EE)])
    if at_grasp(g, offset, angle):
        return Target(Phase.GRASP, at, rotation, 0.0)
    return _approach(g, at, rotation, angle)


def object_in_hand(g: Geometry) -> F64:
    """The object's centre in the `ee` frame [m], (3,)."""
    return g.ee_rotation.T @ (_object(g) - g.ee)


def grasped(g: Geometry, offset: F64) -> bool:
    """The object is between the fingers, and they are as far apart as it is wide."""
    below, above = GRIP_SLACK
    return _inside(offset, IN_HAND) and g.width - below <= g.opening <= g.width + above


def at_grasp(g: Geometry, offset: F64, angle: float) -> bool:
    """Closing the fingers now would hold the object; once they have begun to close, they go on more readily."""
    box = AT_GRASP if open_enough(g) else CLOSING
    return _inside(offset, box) and angle < AT_GRASP_ANGLE and g.object_tilt < MAX_TILT


def open_enough(g: Geometry) -> bool:
    """The fingers pass on both sides of the object."""
    return g.opening >= g.width + OPEN_SLACK


def hand_down(yaw: float) -> F64:
    """Rotation of `ee` with the hand pointing down, turned by `yaw` [rad] about the world's z; (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def grasp_yaw(g: Geometry) -> float:
    """The one of a cube's four grasps that is nearest to the hand's yaw, and a little to none [rad].

    Nearest to the hand, not to zero: a learner that averages both sides of the boundary between two grasps then
    leaves it by any turn, and does not stand still in the middle.
    """
    hand = math.atan2(g.ee_rotation[1, 0], g.ee_rotation[0, 0])
    quarter = math.pi / 2
    turns = (g.object_yaw - quarter, g.object_yaw, g.object_yaw + quarter)
    return min(turns, key=lambda yaw: abs(yaw - hand) + PREFER_ZERO * abs(yaw))


def angle_between(a: F64, b: F64) -> float:
    """Angle of the rotation from `a` to `b`, (3, 3) each [rad]."""
    return math.acos(min(1.0, max(-1.0, (float(a.ravel() @ b.ravel()) - 1) / 2)))


def _reach(g: Geometry) -> Target:
    phase = Phase.AT_GOAL if math.dist(g.goal, g.ee) < AT_GOAL else Phase.CARRY
    return Target(phase, g.goal, hand_down(0.0), 0.0)


def _carry(g: Geometry) -> Target:
    to_goal = g.goal - _object(g)
    horizontal = math.hypot(to_goal[0], to_goal[1])
    lift = min(CARRY_LIFT, CARRY_SLOPE * max(0.0, horizontal - CARRY_FREE))
    phase = Phase.AT_GOAL if math.hypot(*to_goal) < AT_GOAL else Phase.CARRY
    position = g.ee + to_goal + [0.0, 0.0, lift]
    position[2] = max(position[2], LOWEST_EE)
    return Target(phase, position, hand_down(0.0), 0.0)


def _approach(g: Geometry, at: F64, rotation: F64, angle: float) -> Target:
    to_object = at - g.ee
    misaligned = math.hypot(to_object[0], to_object[1]) + ANGLE_AS_LENGTH * max(0.0, angle - ANGLE_FREE)
    ready = open_enough(g) and g.object_tilt < MAX_TILT
    height = min(HOVER, FUNNEL_SLOPE * max(0.0, misaligned - FUNNEL_RADIUS))
    if not ready:
        height = max(height, CLEAR)
    too_low = at[2] + height - g.ee[2]
    sideways = min(1.0, max(0.0, 1.0 - too_low / RISE_FIRST))
    position = np.array([*(g.ee[:2] + sideways * to_object[:2]), at[2] + height])
    phase = Phase.DESCEND if height < HOVER else Phase.APPROACH
    if not open_enough(g):
        phase = Phase.OPEN
    return Target(phase, position, rotation, g.max_opening)


def _object(g: Geometry) -> F64:
    if g.object is None:
        raise ManipError("this rung of the ladder needs an object, and the task has none")
    return g.object


def _inside(offset: F64, box: tuple[float, float, float]) -> bool:
    return abs(offset[0]) <= box[0] and abs(offset[1]) <= box[1] and abs(offset[2]) <= box[2]
