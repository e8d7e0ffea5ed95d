"""Differential inverse kinematics of one arm, with mink."""

import math
from typing import Any

import daqp
import mink
import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import angle_between, rotation_matrix, rotation_vector, yaw_ahead
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_model

_POSITION_COST = 1.0  # [1/m]
_LM_DAMPING = 1e-3
_DAMPING = 1e-5
_UNBOUNDED = 1e30  # DAQP's infinity
_CONVERGED = 1e-4  # weighted pose error that counts as zero [m]
_CORRECTIONS = 3  # Gauss-Newton steps of `moved`; each squares the error
_EXACT = 1e-9  # pose error that counts as zero in `moved` [m] or [rad]
_LEVENBERG = 1e-8  # added to J J^T, so that a singular posture gives a short step
_LARGEST = 0.5  # largest step of a joint in `moved` [rad]


class PoseProgram:
    """mink's quadratic program that moves a site to a pose, within the joints' limits.

    It also moves the joints towards `home`. With the twist e (6,) from the target to the site, its
    Jacobian J (6, n) and the costs W of its entries, the joint displacement dq (n,) minimises

        |W (J dq + e)|^2 + c^2 |q + dq - home|^2 + (d + m |W e|^2) |dq|^2

    subject to g (low - q) <= dq <= g (high - q). c is the posture's cost, g mink's gain of joint
    limits, d = 1e-5, m = 1e-3: the damping grows with the error, so that a singular or distant
    target gives a short step (Sugihara 2011, IEEE Trans. Robotics 27, 984-991).

    Stateless: a solution depends only on the posture in `data`, after `update`, and on `home`.

    Args:
        model: The compiled arm.
        site: Name of the site that is moved.
        home: Joint positions, (n,) [rad].
        costs: Cost of the rotation error [1/rad], relative to 1 [1/m] for the position error, and
            of a joint's distance from `home` [1/rad].
    """

    def __init__(self, model: mujoco.MjModel, site: str, home: F64, costs: tuple[float, float]):
        self._configuration = mink.Configuration(model)
        self.model, self.data = model, self._configuration.data
        orientation, posture = costs
        self.frame = mink.FrameTask(
            site, "site", _POSITION_COST, orientation, lm_damping=_LM_DAMPING
        )
        # Overwritten by `solve`; all of mink's identities share one array.
        self._target = mink.SE3(mink.SE3.identity().wxyz_xyz.copy())
        self.frame.transform_target_to_world = self._target
        # without it a label would depend on the path to the posture
        self.posture = mink.PostureTask(model, posture)
        self.posture.set_target(home)
        limit = mink.ConfigurationLimit(model)
        self._bounded, self._gain = limit.indices.astype(int), limit.gain
        rows = np.eye(model.nv)[self._bounded]
        self._rows, self._lower = np.vstack([rows, -rows]), np.full(2 * len(rows), -_UNBOUNDED)
        self._low, self._high = limit.lower[self._bounded], limit.upper[self._bounded]
        self._sense = np.zeros(2 * len(rows), np.intc)

    def update(self) -> None:
        """Compute what depends on `data.qpos`, Jacobians included."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def solve(self, position: F64, rotation: F64) -> F64 | None:
        """Return a joint displacement towards a pose, (n,) [rad]; None if none is found.

        Args:
            position: Target of the site in the world, (3,) [m].
            rotation: Its target rotation, (3, 3).
        """
        mujoco.mju_mat2Quat(self._target.wxyz_xyz[:4], rotation.ravel())
        self._target.wxyz_xyz[4:] = position
        program: Any = mink.build_ik(
            self._configuration, [self.frame, self.posture], 1.0, _DAMPING, []
        )
        q = self.data.qpos[self._bounded]
        upper = self._gain * np.concatenate([self._high - q, q - self._low])
        # DAQP directly: with qpsolvers and mink's limits a label takes 1.5 times as long.
        x, _, exit_flag, _ = daqp.solve(
            program.P, program.q, self._rows, upper, self._lower, self._sense
        )
        return x if exit_flag > 0 else None


class ArmIK:
    """Inverse kinematics of an arm.

    A step depends only on the posture last given to `ee_pose` and on `home`.
    """

    def __init__(self, robot: Robot):
        model = arm_model(robot)
        self._address = np.array([model.joint(name).qposadr[0] for name in robot.joints])
        home = np.zeros(model.nq)
        home[self._address] = robot.home
        self._site = model.site("ee").id
        self._costs = robot.costs
        self._program = PoseProgram(
            model, "ee", home, (robot.costs.orientation, robot.costs.posture)
        )
        joints = [model.joint(name) for name in robot.joints]
        # (arm, 2) [rad]
        self.limits = np.array(
            [one.range if one.limited[0] else [-np.inf, np.inf] for one in joints]
        )
        self._data = data = self._program.data  # views that follow the posture
        self._ee, self._ee_rotation = (
            data.site_xpos[self._site],
            data.site_xmat[self._site].reshape(3, 3),
        )
        self._qpos = data.qpos
        self._dofs = np.array([joint.dofadr[0] for joint in joints])
        self._jacobian = np.zeros((6, model.nv))
        self._robot, self._shoulder = robot, joints[0].id
        self._links = [int(model.jnt_bodyid[joint.id]) for joint in joints[2:]]

    def ahead(self, position: F64) -> float:
        """Return the world yaw [rad] that counts as zero for a hand at a position (3,) [m]."""
        return yaw_ahead(self._robot, self._data.xanchor[self._shoulder], position)

    def freedom(self, q: F64) -> tuple[float, float]:
        """Return how far a posture (arm,) [rad] is from a singular one, and from the table.

        Returns:
            The Jacobian's smallest singular value, which is 0 in a singular posture, and the height
            of the lowest link beyond the shoulder [m], 0 if there is none.
        """
        self.ee_pose(q)
        values = np.linalg.svd(self._site_jacobian(), compute_uv=False)
        return float(values[-1]), float(min(self._data.xpos[self._links, 2], default=0.0))

    def ee_pose(self, q: F64) -> tuple[F64, F64]:
        """Return the position (3,) [m] and the rotation matrix (3, 3) of `ee` in the world.

        Args:
            q: The posture, (arm,) [rad], from which the next `step` starts.
        """
        self._qpos[self._address] = q
        self._program.update()
        return self._ee.copy(), self._ee_rotation.copy()

    def displacement(
        self, position: F64, rotation: F64, largest: float, weight: float | None = None
    ) -> F64 | None:
        """Return the joint displacement of one `step` alone, without the error that remains.

        It starts from the posture of the last `ee_pose` call.

        Args:
            position: Target of `ee` in the world, (3,) [m].
            rotation: Its target rotation, (3, 3).
            largest: Longest step of a joint [rad].
            weight: Cost per radian of rotation error; by default `Costs.orientation`.

        Returns:
            The displacement, (arm,) [rad], scaled down as a whole if one joint exceeds `largest`;
            None if the program has no solution.
        """
        self._program.frame.cost[3:] = self._costs.orientation if weight is None else weight
        x = self._program.solve(position, rotation)
        if x is None:
            return None
        dq = x[self._address]
        longest = max(map(abs, dq.tolist()))
        return dq * (largest / longest) if longest > largest else dq

    def step(
        self, position: F64, rotation: F64, largest: float, lean: float = 0.0
    ) -> tuple[F64, float] | None:
        """Return one step towards a pose of `ee`.

        It starts from the posture of the `ee_pose` call that must precede each step.

        Args:
            position: Target of `ee` in the world, (3,) [m].
            rotation: Its target rotation, (3, 3).
            largest: Longest step of a joint [rad].
            lean: From 0 to 1, how far the hand may lean from the rotation to reach the position.

        Returns:
            The joint displacement, (arm,) [rad], scaled down as a whole if one joint exceeds
            `largest`, and the share of the weighted pose error that remains; None if the program
            has no solution.
        """
        costs = self._costs
        weight = costs.orientation + lean * (costs.leaning - costs.orientation)
        before = self._pose_error(position, rotation, weight)
        dq = self.displacement(position, rotation, largest, weight)
        if dq is None:
            return None
        if before < _CONVERGED:
            return dq, 0.0
        self._qpos[self._address] += dq
        mujoco.mj_kinematics(self._program.model, self._data)
        return dq, self._pose_error(position, rotation, weight) / before

    def moved(self, q: F64, motions: F64) -> F64:
        """Return joints that move `ee` by given motions, (B, arm) [rad].

        They are within their limits and near `q`. A pose out of reach is only approached.

        The first step is `displacement`, which resolves redundancy (the elbow of an arm with seven
        joints) as for the expert. The corrections after it are damped least-squares steps, dq = J^T
        (J J^T + 1e-8 I)^-1 e (Nakamura and Hanafusa 1986, J. Dyn. Sys. Meas. Control 108, 163-171).

        Args:
            q: Measured joints, (B, arm) [rad].
            motions: Translations [m] and rotation vectors [rad] of `ee` in the world's axes,
                (B, 6).
        """
        return np.array([self._moved(*row) for row in zip(q, motions, strict=True)]).reshape(
            q.shape
        )

    def _moved(self, q: F64, motion: F64) -> F64:
        position, rotation = self.ee_pose(q)
        position, rotation = position + motion[:3], rotation_matrix(motion[3:]) @ rotation
        dq = self.displacement(position, rotation, _LARGEST)
        q = np.clip(q if dq is None else q + dq, *self.limits.T)
        for _ in range(_CORRECTIONS):
            at, turned = self.ee_pose(q)
            error = np.append(position - at, rotation_vector(rotation @ turned.T))
            if np.abs(error).max() < _EXACT:
                break
            jacobian = np.ascontiguousarray(self._site_jacobian())
            dq = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _LEVENBERG * np.eye(6), error)
            q = np.clip(q + dq * (_LARGEST / max(np.abs(dq).max(), _LARGEST)), *self.limits.T)
        return q

    def _site_jacobian(self) -> F64:
        """Jacobian of `ee` by the arm's joints, rows for position first, in the last `ee_pose`
        posture; (6, arm).
        """
        jacobian = self._jacobian
        mujoco.mj_jacSite(self._program.model, self._data, jacobian[:3], jacobian[3:], self._site)
        return jacobian[:, self._dofs]

    def _pose_error(self, position: F64, rotation: F64, weight: float) -> float:
        """Pose error [m], weighted as by the frame task: position by 1, angle by `weight`
        [m/rad].
        """
        dx, dy, dz = (self._ee - position).tolist()
        return math.hypot(dx, dy, dz, weight * angle_between(self._ee_rotation, rotation))
