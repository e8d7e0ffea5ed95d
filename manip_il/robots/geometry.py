"""Outlines of geoms, distances between them, and collisions of a robot with itself and what is around it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import mujoco
import numpy as np

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.robots.robot import GRIPPER, Robot
from manip_il.robots.spec import arm_spec

_AT_TIP = 0.025  # distance from a fingertip beyond which a geom is no pad [m]
_FAR = 1.0  # longest distance that is measured [m]
_NUDGES = (0.0, 1e-5, -1e-5, 3e-5)  # [m]
_DEEP = 1e-3  # parts that overlap by less merely touch [m]
_BEYOND = 1e-6  # tolerated rounding error at a limit [rad]
CLEARANCE = 0.02  # parts nearer than this collide [m]
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
Pair = tuple[str, str]


def outline(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> F64:
    """Return points around a geom in the world, (n, 3) [m]: its mesh's vertices, or its box's corners."""
    mesh, middle, half = int(model.geom_dataid[geom]), model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    points = middle + half * _CORNERS
    if mesh >= 0:  # the box of a mesh that is rotated in its geom is too large
        start = model.mesh_vertadr[mesh]
        points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    return data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T


def at_tip(model: mujoco.MjModel, data: mujoco.MjData, finger: Sequence[int], along: F64) -> list[int]:
    """Return the geoms of a finger that reach near its tip, along a direction (3,) of the world."""
    ends = {geom: float((outline(model, data, geom) @ along).max()) for geom in finger}
    return [geom for geom in finger if ends[geom] > max(ends.values()) - _AT_TIP]


def distance(model: mujoco.MjModel, data: mujoco.MjData, one: int, other: int, ends: F64 | None = None) -> float:
    """Return the distance of two geoms, at most 1 m, and put their nearest points (6,) into `ends`; [m].

    For two separate geoms MuJoCo sometimes returns exactly 0, but not once one is moved slightly.
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
    """Return the nearest geoms of the first group and of the others, and their nearest points, (2, 3) [m]."""
    first, *rest = groups
    least, pair, points, ends = np.inf, (first[0], rest[0][0]), np.zeros(6), np.empty(6)
    for one, other in itertools.product(first, [geom for group in rest for geom in group]):
        apart = distance(model, data, one, other, ends)
        if apart < least:
            least, pair, points = apart, (one, other), ends.copy()
    return pair, points.reshape(2, 3)


class Body:
    """The whole robot, to detect self-collisions that it does not have at home."""

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
        """Return the pairs of parts, as bodies, that collide at joints (arm,) [rad]."""
        self._data.qpos[self._q] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        bodies = self._model.geom_bodyid
        return frozenset(frozenset((int(bodies[c.geom1]), int(bodies[c.geom2]))) for c in self._data.contact)


def meeting_at(robot: Robot, model: mujoco.MjModel, prefix: str, posture: F64) -> dict[Pair, float]:
    """Return the pairs of bodies that overlap in a posture of the arm (arm,) [rad], the gripper open, and how deep [m].

    A pair is two bodies of the robot, or one and a fixed part of the world, which is named by its geom.
    prefix: prefix of the robot's names in a scene's model.
    """
    data, gripper = mujoco.MjData(model), robot.gripper
    for names, values in ((robot.joints, posture), (gripper.joints, gripper.open)):
        for name, value in zip(names, values, strict=True):
            data.joint(prefix + name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    found: dict[Pair, float] = {}
    for contact in data.contact:
        bodies = [int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2)]
        ours = [model.body(body).name.startswith(prefix) for body in bodies]
        if contact.dist < -_DEEP and any(ours) and all(our or not body for our, body in zip(ours, bodies, strict=True)):
            geoms = (contact.geom1, contact.geom2)
            names = [_name(model, int(geom), prefix) for geom in geoms]
            pair = (min(names), max(names))
            found[pair] = max(found.get(pair, 0.0), -float(contact.dist))
    return found


def require_free_home(robot: Robot, model: mujoco.MjModel, prefix: str) -> None:
    """Raise `UsageError` for a `home` beyond a joint's limits, or in which parts overlap.

    Two parts of the robot may overlap if they also do so at zero, as neighbours do in many models.
    """
    for name, value in zip(robot.joints, robot.home, strict=True):
        joint = model.joint(prefix + name)
        low, high = joint.range
        if joint.limited[0] and not low - _BEYOND <= value <= high + _BEYOND:
            raise UsageError(
                f"robot {robot.name}: home is {value:g} for joint {name!r}, whose limits are {low:.4g} to {high:.4g}; "
                "choose another home, or omit it to have one computed"
            )
    meeting = meeting_at(robot, model, prefix, np.asarray(robot.home))
    if not meeting:
        return
    bodies = {model.body(body).name.removeprefix(prefix) for body in range(1, model.nbody)}
    always = {pair for pair in meeting_at(robot, model, prefix, np.zeros(len(robot.joints))) if bodies.issuperset(pair)}
    for (one, other), depth in sorted(meeting.items(), key=lambda item: -item[1]):
        if (one, other) not in always:
            mounted = one.startswith(GRIPPER) != other.startswith(GRIPPER)
            mount = ", gripper.position or gripper.quaternion" if mounted else ""
            raise UsageError(
                f"robot {robot.name}: at home {one!r} and {other!r} overlap by {1000 * depth:.0f} mm; choose another "
                f"home, or omit it to have one computed, or change base or workspace.centre{mount}"
            )


def _name(model: mujoco.MjModel, geom: int, prefix: str) -> str:
    body = int(model.geom_bodyid[geom])
    return model.body(body).name.removeprefix(prefix) if body else model.geom(geom).name
