"""A gripper as its opening [m] between the pads, whatever drives the fingers and however they move.

Command and opening are related by a sweep: when a robot is first used, its actuators are moved from closed to open and
the distance is measured at which the fingers come to rest. So parallel, hinged and linked fingers are alike.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UsageError
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_spec

F64 = NDArray[np.float64]
TOUCH = 0.0015  # a finger this near to an object touches it [m]
_COMMANDS = 15  # of the sweep from closed to open
_SETTLE = 250  # physics steps at each
_STEP = 0.002  # [s]
_FAR = 1.0  # longest distance between fingers that is measured [m]
_PAD = 0.004  # what is this much farther from the other finger than the nearest is no pad [m]
_LEAST_TRAVEL = 0.005  # a gripper that opens by less grips nothing [m]


@dataclass(frozen=True, eq=False)
class Sweep:
    """Measured relation of command and opening.

    shares: of the way from closed to open, commanded and measured, rising, (c,). openings: between the pads at rest
    [m], rising, (c,). pads: for each finger its geoms' places among the finger's, the nearest to the other one first.
    """

    shares: F64
    openings: F64
    pads: tuple[tuple[int, ...], ...]


class Gripper:
    """The gripper of a robot within a compiled model. prefix: of the robot's names there."""

    def __init__(self, robot: Robot, model: mujoco.MjModel, prefix: str = ""):
        config, self._sweep = robot.gripper, sweep(robot)
        self.q = np.array([model.joint(prefix + name).qposadr[0] for name in config.joints], dtype=np.int64)
        self.ctrl = np.array([model.actuator(prefix + name).id for name in config.joints], dtype=np.int64)
        self._closed, self._open = np.asarray(config.closed), np.asarray(config.open)
        self._travel = self._open - self._closed
        weights = 1 / (self._travel * len(self._travel))  # of the joints in the share of the way that is gone
        self._weights = tuple(zip(self.q.tolist(), weights.tolist(), strict=True))
        self._offset = float(weights @ self._closed)
        self._points = self._sweep.shares.tolist(), self._sweep.openings.tolist()  # numpy's interp takes 3 us
        fingers = [_finger_geoms(model, prefix + name) for name in config.fingers]
        self.geoms = frozenset(geom for finger in fingers for geom in finger)
        self.pads = tuple(
            tuple(finger[i] for i in pads) for finger, pads in zip(fingers, self._sweep.pads, strict=True)
        )
        self.least, self.most = float(self._sweep.openings[0]), float(self._sweep.openings[-1])

    def opening(self, qpos: F64) -> float:
        """Return the opening between the pads [m]."""
        share = sum(weight * qpos[at] for at, weight in self._weights) - self._offset
        shares, openings = self._points
        last = min(max(bisect.bisect_right(shares, share), 1), len(shares) - 1)
        along = min(max((share - shares[last - 1]) / (shares[last] - shares[last - 1]), 0.0), 1.0)
        return float(openings[last - 1] + along * (openings[last] - openings[last - 1]))

    def command(self, opening: float) -> F64:
        """Return the actuators' commands for an opening [m], (g,)."""
        share = np.interp(opening, self._sweep.openings, self._sweep.shares)
        return self._closed + share * self._travel

    def commanded(self, commands: F64, before: F64) -> float:
        """Return the opening [m] that commands (g,) ask for: of the actuator that they move farthest from `before`."""
        shares = (commands - self._closed) / self._travel
        moved = np.abs(shares - (before - self._closed) / self._travel)
        return float(np.interp(shares[moved.argmax()], self._sweep.shares, self._sweep.openings))

    def touches(self, model: mujoco.MjModel, data: mujoco.MjData, geoms: tuple[int, ...]) -> bool:
        """Return whether every finger touches one of an object's geoms. Needs kinematics to be up to date in `data`."""
        # For two boxes that are apart `mj_geomDistance` now and then returns 0, but only within its greatest distance.
        return all(
            any(mujoco.mj_geomDistance(model, data, pad, geom, TOUCH, None) < TOUCH for pad in pads for geom in geoms)
            for pads in self.pads
        )


@cache
def sweep(robot: Robot) -> Sweep:
    """Move a robot's gripper from closed to open and measure where the fingers come to rest.

    Raises `UsageError` where they do not come apart.
    """
    spec = arm_spec(robot)
    spec.option.timestep, spec.option.integrator = _STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    data, config = mujoco.MjData(model), robot.gripper
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos[0] = data.actuator(name).ctrl[0] = value
    q = np.array([model.joint(name).qposadr[0] for name in config.joints])
    ctrl = np.array([model.actuator(name).id for name in config.joints])
    fingers = [_finger_geoms(model, name) for name in config.fingers]
    closed, travel = np.asarray(config.closed), np.subtract(config.open, config.closed)
    data.qpos[q] = closed
    shares, openings, pads = [], [], ()
    for share in np.linspace(0, 1, _COMMANDS):
        data.ctrl[ctrl] = closed + share * travel
        mujoco.mj_step(model, data, _SETTLE)
        mujoco.mj_kinematics(model, data)
        gaps = _gaps(model, data, fingers)
        shares.append(float(((data.qpos[q] - closed) / travel).mean()))
        openings.append(min(float(gap.min()) for gap in gaps))
        pads = pads or tuple(_pads(gap) for gap in gaps)
    if openings[-1] - openings[0] < _LEAST_TRAVEL or (np.diff(openings) <= 0).any() or (np.diff(shares) <= 0).any():
        raise UsageError(
            f"robot {robot.name}: the fingers stand {openings[0]:.3f} m apart closed and {openings[-1]:.3f} m open; "
            "expected them to come apart all the way: look at gripper.closed, gripper.open and gripper.fingers"
        )
    return Sweep(np.array(shares), np.array(openings), pads)


def _gaps(model: mujoco.MjModel, data: mujoco.MjData, fingers: list[tuple[int, ...]]) -> list[F64]:
    """For each finger, how far each of its geoms is from the other fingers [m]."""
    gaps = []
    for finger in fingers:
        others = [geom for other in fingers if other is not finger for geom in other]
        distance = [
            min(mujoco.mj_geomDistance(model, data, one, other, _FAR, None) for other in others) for one in finger
        ]
        gaps.append(np.array(distance))
    return gaps


def _pads(gaps: F64) -> tuple[int, ...]:
    order = np.argsort(gaps, kind="stable")
    return tuple(int(i) for i in order if gaps[i] <= gaps.min() + _PAD)


def _finger_geoms(model: mujoco.MjModel, body: str) -> tuple[int, ...]:
    """Return the ids of the geoms of a finger and of what hangs on it that can touch things."""
    root = model.body(body).id
    bodies = {root}
    for child in range(root + 1, model.nbody):
        if model.body_parentid[child] in bodies:
            bodies.add(child)
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = tuple(i for i in range(model.ngeom) if model.geom_bodyid[i] in bodies and touching[i])
    if not geoms:
        raise UsageError(f"finger {body!r} has no geom that can touch anything; expected at least one")
    return geoms
