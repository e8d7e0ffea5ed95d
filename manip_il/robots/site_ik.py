"""Differential inverse kinematics of an arm that no YAML describes: its model, and a site of its hand."""

from __future__ import annotations

from collections.abc import Callable

import daqp
import mink
import mujoco
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_LM_DAMPING = 1e-3
_DAMPING = 1e-5
_UNBOUNDED = 1e30  # DAQP's infinity


class SiteIK:
    """Stateless: every step starts from the measured `q` (n,) and a fixed home posture (n,).

    model: of the arm alone, with one degree of freedom a joint. costs: of the hand's position [1/m] and rotation
    [1/rad]. posture: cost of every joint off the home posture where the arm is at `q`, (n,) [1/rad].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        site: str,
        home: F64,
        costs: tuple[float, float],
        posture: Callable[[F64], F64],
    ):
        self._model, self._home, self._posture = model, home, posture
        self._configuration = mink.Configuration(model)
        self._frame = mink.FrameTask(site, "site", *costs, lm_damping=_LM_DAMPING)
        self._frame.set_target(mink.SE3.identity())
        limit = mink.ConfigurationLimit(model)
        bounded = limit.indices.astype(int)
        rows = np.eye(model.nv)[bounded]
        self._rows, self._gain = np.vstack([rows, -rows]), limit.gain
        self._bounded, self._sign = np.tile(bounded, 2), np.repeat([-1.0, 1.0], len(bounded))
        self._ends = np.concatenate([limit.upper[bounded], -limit.lower[bounded]])
        self._lower, self._sense = np.full(len(self._rows), -_UNBOUNDED), np.zeros(len(self._rows), np.intc)

    def step(self, q: F64, position: F64, rotation: F64) -> F64 | None:
        """Return the displacement (n,) [rad] from `q` (n,) towards a pose of the site, (3,) [m] and (3, 3).

        None where the quadratic program has no solution.
        """
        data, target = self._configuration.data, self._frame.transform_target_to_world
        assert target is not None
        data.qpos[:] = q
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mju_mat2Quat(target.wxyz_xyz[:4], rotation.ravel())
        target.wxyz_xyz[4:] = position
        # mink's quadratic program of a pose and a posture; DAQP itself, as through qpsolvers it takes thrice as long.
        jacobian, error, damping = self._frame.compute_qp_residual(self._configuration)
        posture = self._posture(q) ** 2
        hessian = jacobian.T.dot(jacobian)
        hessian.flat[:: self._model.nv + 1] += _DAMPING + damping + posture
        gradient = -error.dot(jacobian) - posture * (self._home - q)
        upper = (self._ends + self._sign * q[self._bounded]) * self._gain
        x, _, exit_flag, _ = daqp.solve(hessian, gradient, self._rows, upper, self._lower, self._sense)
        return x if exit_flag > 0 else None
