"""The expert: a function of `State` alone, from anywhere a learner can get to."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import MismatchError
from manip_il.expert.ik import ArmIK
from manip_il.expert.skills import CUBE_WIDTH, Geometry, Target, angle_between, choose
from manip_il.mdp import Label, Phase, State
from manip_il.sim.observe import cube_yaw
from manip_il.sim.scene import Scene
from manip_il.sim.task import in_reach
from manip_il.sim.world import CUBE_HALF_SIZE

F64 = NDArray[np.float64]

MAX_POSITION_STEP = 0.12  # the hand's target runs ahead of it by this much at most [m]
MAX_ANGLE_STEP = 0.6  # [rad]
FALLEN = -0.05  # an object under this height has left the table [m]
REACH_SLACK = 0.05  # beyond the reach that tasks draw from, the hand still gets there less exactly [m]
NO_PROGRESS = 0.995  # a step that leaves this share of an error is none
NEAR = 0.03  # weighted pose error below which no progress is no trouble [m]


class Expert:
    """Labels any state of one scene.

    The same state gives bit-equal labels in any order and any process: inverse kinematics starts from the
    measured joints with a fixed posture target, and the phase is read off the geometry. Gripper opening is
    the only memory.
    """

    def __init__(self, scene: Scene):
        self._scene, self._robot = scene, scene.robot
        self._ik = ArmIK(scene.robot)
        self._qpos = scene.qpos_slice
        self._size = scene.state_size
        self._low, self._high = scene.arm_range.T
        self._width = CUBE_WIDTH - scene.robot.pad_gap

    def label(self, state: State) -> Label:
        """The expert's action in `state`: joint targets [rad] and gripper command [m], (n,).

        Where there is no sound action (object out of reach, inverse kinematics without a solution), `valid`
        is false, `reason` says why, and the action holds the arm still. Raises `MismatchError` for a state of
        another scene.
        """
        if len(state.physics) != self._size:
            name = f"{self._robot.name} {self._scene.task.name}"
            raise MismatchError("size of the physics state", "the state", len(state.physics), name, self._size)
        qpos = state.physics[self._qpos]
        q = qpos[self._scene.arm_q]
        geometry = self._geometry(qpos, q, state.goal)
        reason = self._unsound(geometry)
        if reason:
            return self._hold(q, geometry.opening, reason)
        target = choose(geometry)
        return self._towards(q, geometry, target)

    def _geometry(self, qpos: F64, q: F64, goal: F64) -> Geometry:
        scene, robot = self._scene, self._robot
        ee, rotation = self._ik.ee_pose(q)
        fingers = qpos[scene.finger_q]
        opening = float(fingers[0] + fingers[1])
        if scene.object_q is None:
            return Geometry(ee, rotation, opening, goal, robot.max_opening, self._width)
        at = scene.object_q
        yaw, tilt = cube_yaw(qpos[at + 3 : at + 7])
        return Geometry(ee, rotation, opening, goal, robot.max_opening, self._width, qpos[at : at + 3], yaw, tilt)

    def _unsound(self, g: Geometry) -> str:
        if g.object is None:
            return ""
        if g.object[2] < FALLEN:
            return "object off the table"
        in_hand = math.dist(g.object, g.ee) < CUBE_HALF_SIZE
        if not in_hand and not in_reach(self._robot, g.object, REACH_SLACK):
            return "object out of reach"
        return ""

    def _towards(self, q: F64, g: Geometry, target: Target) -> Label:
        position = g.ee + _clip_norm(target.position - g.ee, MAX_POSITION_STEP)
        rotation = _turn_towards(g.ee_rotation, target.rotation, MAX_ANGLE_STEP)
        step = self._ik.step(position, rotation, self._robot.max_joint_step)
        if step is None:
            return self._hold(q, g.opening, "inverse kinematics has no solution")
        dq, residual = step
        if residual > NO_PROGRESS and math.dist(position, g.ee) > NEAR:
            return self._hold(q, g.opening, "no joint step brings the hand nearer")
        arm = np.minimum(np.maximum(q + dq, self._low), self._high)
        return Label(np.append(arm, target.opening), target.phase, True, residual)

    def _hold(self, q: F64, opening: float, reason: str) -> Label:
        arm = np.minimum(np.maximum(q, self._low), self._high)
        return Label(np.append(arm, opening), Phase.NONE, False, 1.0, reason)


def _clip_norm(vector: F64, longest: float) -> F64:
    norm = math.hypot(*vector)
    return vector if norm <= longest else vector * (longest / norm)


def _turn_towards(rotation: F64, target: F64, largest: float) -> F64:
    """The rotation at most `largest` [rad] from `rotation` on the shortest way to `target` (Rodrigues' formula)."""
    angle = angle_between(rotation, target)
    if angle <= largest:
        return target
    between = rotation.T @ target
    skew = between - between.T
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    length = math.hypot(*axis)
    if length < 1e-6:  # half a turn: every axis is as near
        axis, length = np.array([0.0, 0.0, 1.0]), 1.0
    x, y, z = axis / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return rotation @ (np.eye(3) + np.sin(largest) * cross + (1 - np.cos(largest)) * cross @ cross)
