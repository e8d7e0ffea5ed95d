"""Whether a robot meets itself in a posture."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_spec

F64 = NDArray[np.float64]
CLEARANCE = 0.02  # parts that are nearer than that meet [m]


class Body:
    """The whole robot, to see whether parts of it meet that are apart at home."""

    def __init__(self, robot: Robot):
        self._model = arm_spec(robot).compile()
        self._model.geom_margin[:] = CLEARANCE
        self._data = mujoco.MjData(self._model)
        self._q = np.array([self._model.joint(name).qposadr[0] for name in robot.joints])
        gripper = [self._model.joint(name).qposadr[0] for name in robot.gripper.joints]
        self._data.qpos[gripper] = robot.gripper.open
        self._at_home = frozenset[frozenset[int]]()
        self._at_home = self._meeting(np.asarray(robot.home))

    def meets_itself(self, q: F64) -> bool:
        """Return whether parts meet at joints (arm,) [rad] that are apart at home."""
        return not self._meeting(q) <= self._at_home

    def meeting(self, q: F64) -> int:
        """Return how many pairs of parts meet at joints (arm,) [rad]."""
        return len(self._meeting(q))

    def _meeting(self, q: F64) -> frozenset[frozenset[int]]:
        self._data.qpos[self._q] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        bodies = self._model.geom_bodyid
        return frozenset(frozenset((int(bodies[c.geom1]), int(bodies[c.geom2]))) for c in self._data.contact)
