"""Outlines of geoms, distances between them, and collisions of a robot with itself.

Rotations of a hand: matrices from and to rotation vectors and yaws, and angles between them.
"""

import itertools
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_spec

_AT_TIP = 0.025  # a geom that ends farther than this from its finger's tip is not at the tip [m]
_FAR = 1.0  # longest distance that is measured [m]
# shifts of a geom, tried in order until the distance is not 0 [m]
_NUDGES = (0.0, 1e-5, -1e-5, 3e-5)
CLEARANCE = 0.02  # parts nearer than this count as colliding [m]
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> F64:
    """Return points around a geom in the world, (n, 3) [m].

    They are the vertices of its mesh, or else the corners of its box.

    Args:
        model: The compiled model.
        data: Its data, with up-to-date kinematics.
        geom: Id of the geom.
    """
    mesh = int(model.geom_dataid[geom])
    middle, half = model.geom_aabb[geom].reshape(2, 3)
    points = middle + half * _CORNERS
    # the corners of its box would be too far out, as a mesh may be rotated in its geom
    if mesh >= 0:
        start = model.mesh_vertadr[mesh]
        points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    return data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T


def at_tip(
    model: mujoco.MjModel, data: mujoco.MjData, finger: Sequence[int], along: F64
) -> list[int]:
    """Return the geoms of a finger that extend nearly to its tip.

    Args:
        model: The compiled model.
        data: Its data, with up-to-date kinematics.
        finger: Ids of the finger's geoms.
        along: Direction in which the finger points, a unit vector in the world, (3,).
    """
    ends = {geom: float((outline(model, data, geom) @ along).max()) for geom in finger}
    return [geom for geom in finger if ends[geom] > max(ends.values()) - _AT_TIP]


def distance(
    model: mujoco.MjModel, data: mujoco.MjData, one: int, other: int, ends: F64 | None = None
) -> float:
    """Return the distance between two geoms [m], at most 1 m.

    MuJoCo sometimes returns exactly 0 for two separate geoms: `one` is then shifted slightly and
    measured again.

    Args:
        model: The compiled model.
        data: Its data, with up-to-date kinematics.
        one: Id of a geom.
        other: Id of the other geom.
        ends: If given, overwritten with the nearest points of `one` and `other`, (6,) [m].
    """
    place = data.geom_xpos[one].copy()
    apart = 0.0
    for nudge in _NUDGES:
        data.geom_xpos[one] = place + nudge
        apart = mujoco.mj_geomDistance(model, data, one, other, _FAR, ends)
        if apart != 0.0:
            break
    data.geom_xpos[one] = place
    return apart


def nearest(
    model: mujoco.MjModel, data: mujoco.MjData, groups: Sequence[Sequence[int]]
) -> tuple[tuple[int, int], F64]:
    """Find the nearest pair of a geom in the first group and one in another group.

    Args:
        model: The compiled model.
        data: Its data, with up-to-date kinematics.
        groups: Ids of the geoms of two groups or more, such as fingers.

    Returns:
        The ids of the two geoms, and the nearest points on them, (2, 3) [m].
    """
    first, *rest = groups
    least = np.inf
    pair = (first[0], rest[0][0])
    points = np.zeros(6)
    ends = np.empty(6)
    for one, other in itertools.product(first, itertools.chain(*rest)):
        apart = distance(model, data, one, other, ends)
        if apart < least:
            least = apart
            pair = (one, other)
            points = ends.copy()
    return pair, points.reshape(2, 3)


class Body:
    """A robot with its gripper open, to detect self-collisions that do not occur at home."""

    def __init__(self, robot: Robot):
        self._model = arm_spec(robot).compile()
        self._model.geom_margin[:] = CLEARANCE
        self._data = mujoco.MjData(self._model)
        self._q = [self._model.joint(name).qposadr[0] for name in robot.joints]
        for name, place in zip(robot.gripper.joints, robot.gripper.open, strict=True):
            self._data.joint(name).qpos[0] = place
        self._at_home = self.meeting(np.asarray(robot.home))

    def meets_itself(self, q: F64) -> bool:
        """Return whether parts that are apart at home collide at joints (arm,) [rad]."""
        return not self.meeting(q) <= self._at_home

    def meeting(self, q: F64) -> set[tuple[int, int]]:
        """Return the pairs of bodies, by id, that collide at joints (arm,) [rad]."""
        self._data.qpos[self._q] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        bodies = self._model.geom_bodyid
        pairs = np.sort(bodies[self._data.contact.geom], axis=1).tolist()
        return {(one, other) for one, other in pairs}


def rotation_vector(rotation: F64) -> F64:
    """Return the rotation vector of a rotation matrix (3, 3): axis times angle, (3,) [rad].

    It is at most pi long.
    """
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
    """Return the rotation of `ee` with the hand pointing down, (3, 3).

    Args:
        yaw: Turn of the hand about the world's z [rad].
    """
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def turn_about_z(yaw: float) -> F64:
    """Return the rotation (3, 3) about the world's z by `yaw` [rad]."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_ahead(robot: Robot, shoulder: F64, position: F64) -> float:
    """Return the world yaw [rad] that counts as zero for the hand.

    It is 0, or the direction away from the shoulder for a robot that leans.

    Args:
        robot: The robot.
        shoulder: Position of the arm's first joint, (3,) [m].
        position: Position of the hand, (3,) [m].
    """
    return math.atan2(position[1] - shoulder[1], position[0] - shoulder[0]) if robot.leans else 0.0


def angle_ahead(rotation: F64) -> float:
    """Return the yaw of the x axis of a rotation (3, 3) [rad]."""
    return math.atan2(rotation[1, 0], rotation[0, 0])


def angle_across(rotation: F64) -> float:
    """Return the yaw [rad] of a hand from the direction in which its fingers move.

    Args:
        rotation: Rotation of the hand, which may lean, (3, 3).
    """
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
    """Return a rotation turned towards another along the shortest path, (3, 3).

    Args:
        rotation: Rotation to start from, (3, 3).
        target: Rotation to turn towards, (3, 3).
        largest: Largest angle to turn by [rad]; the target itself is returned if it is no farther.
    """
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
