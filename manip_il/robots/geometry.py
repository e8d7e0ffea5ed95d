"""Outlines of geoms, distances between them, and collisions of a robot with itself."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_spec

_AT_TIP = 0.025  # a geom that ends farther than this from its finger's tip is not at the tip [m]
_FAR = 1.0  # longest distance that is measured [m]
_NUDGES = (0.0, 1e-5, -1e-5, 3e-5)  # shifts of a geom, tried in order until the distance is not 0 [m]
CLEARANCE = 0.02  # parts nearer than this count as colliding [m]
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> F64:
    """Return points around a geom in the world, (n, 3) [m]: its mesh's vertices, or its box's corners."""
    mesh = int(model.geom_dataid[geom])
    middle = model.geom_aabb[geom, :3]
    half = model.geom_aabb[geom, 3:]
    points = middle + half * _CORNERS
    if mesh >= 0:  # the corners of its box would be too far out, as a mesh may be rotated in its geom
        start = model.mesh_vertadr[mesh]
        points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    return data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T


def at_tip(model: mujoco.MjModel, data: mujoco.MjData, finger: Sequence[int], along: F64) -> list[int]:
    """Return the geoms of a finger that extend nearly to its tip. along: the finger's direction in the world, (3,)."""
    ends = {geom: float((outline(model, data, geom) @ along).max()) for geom in finger}
    return [geom for geom in finger if ends[geom] > max(ends.values()) - _AT_TIP]


def distance(model: mujoco.MjModel, data: mujoco.MjData, one: int, other: int, ends: F64 | None = None) -> float:
    """Return the distance between two geoms [m], at most 1 m, and put their nearest points (6,) [m] into `ends`.

    MuJoCo sometimes returns exactly 0 for two separate geoms: `one` is then shifted slightly and measured again.
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


def nearest(model: mujoco.MjModel, data: mujoco.MjData, groups: Sequence[Sequence[int]]) -> tuple[tuple[int, int], F64]:
    """Return the nearest pair of a geom in the first group and one in another, with their nearest points (2, 3) [m]."""
    first, *rest = groups
    least = np.inf
    pair = (first[0], rest[0][0])
    points = np.zeros(6)
    ends = np.empty(6)
    for one, other in itertools.product(first, [geom for group in rest for geom in group]):
        apart = distance(model, data, one, other, ends)
        if apart < least:
            least = apart
            pair = (one, other)
            points = ends.copy()
    return pair, points.reshape(2, 3)


class Body:
    """A robot with its gripper open, to detect self-collisions other than those in its home posture."""

    def __init__(self, robot: Robot):
        self._model = arm_spec(robot).compile()
        self._model.geom_margin[:] = CLEARANCE
        self._data = mujoco.MjData(self._model)
        self._q = np.array([self._model.joint(name).qposadr[0] for name in robot.joints])
        gripper = [self._model.joint(name).qposadr[0] for name in robot.gripper.joints]
        self._data.qpos[gripper] = robot.gripper.open
        self._at_home = self.meeting(np.asarray(robot.home))

    def meets_itself(self, q: F64) -> bool:
        """Return whether parts that are apart at home collide at joints (arm,) [rad]."""
        return not self.meeting(q) <= self._at_home

    def meeting(self, q: F64) -> frozenset[frozenset[int]]:
        """Return the pairs of bodies, by id, that collide at joints (arm,) [rad]."""
        self._data.qpos[self._q] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        bodies = self._model.geom_bodyid
        return frozenset(frozenset((int(bodies[c.geom1]), int(bodies[c.geom2]))) for c in self._data.contact)
