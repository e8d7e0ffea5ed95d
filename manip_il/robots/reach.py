"""A map of the points that a robot's downward hand reaches by inverse kinematics.

It is computed once per robot and stored. A robot that ships with the package has it beside its
YAML; any other has it in the user's cache, under a hash of the compiled model and the rest of the
YAML.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from operator import lt
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from manip_il.checks import open_outside, without_link
from manip_il.mdp import F64
from manip_il.robots import HERE, ROBOTS
from manip_il.robots.geometry import (
    CLEARANCE,
    Body,
    angle_between,
    angle_off_vertical,
    hand_down,
    off_yaw,
)
from manip_il.robots.robot import ModelFiles, Robot
from manip_il.robots.spec import arm_spec, model_bytes
from manip_il.robots.table import get_robot

if TYPE_CHECKING:
    from manip_il.robots.ik import ArmIK

_CELL = 0.05  # grid spacing [m]
_BEYOND = 0.3  # how far the map extends around the workspace [m]
_ABOVE = 0.05  # how far the map extends above the workspace [m]
_VERSION = 2  # version of the map's computation
_STEPS = 80  # most steps of inverse kinematics
# pose error that counts as converged [m]; what a radian adds to it [m/rad]
_NEAR, _ANGLE = 1e-3, 0.05
ARRIVES = 0.004  # pose error below which the hand counts as arrived [m]
STRETCH = 0.02  # pose error below which the hand counts as near [m]
_LEAN = 0.13  # how much farther sideways a leaning hand reaches [m]
_MOST_LEAN = 1.0  # largest lean of a hand that the arm cannot point straight down [rad]
_BLOCKED = 0.1  # error added for a posture in which the robot collides with itself [m]


@dataclass(frozen=True, eq=False)
class Reach:
    """A grid of points and an error for each: how far from the point the downward hand ends up.

    Eight neighbouring points are the corners of a cell.

    Attributes:
        origin: The grid's first point, (3,) [m].
        errors: Error at each point, an array with the axes x, y and z [m].
    """

    origin: F64
    errors: F64

    @cached_property
    def arrives(self) -> NDArray[np.bool_]:
        """Whether the hand reaches all corners of each cell of the grid, (x - 1, y - 1, z - 1)."""
        there = self.errors < ARRIVES
        for axis in range(3):
            there = np.delete(there, -1, axis) & np.delete(there, 0, axis)
        return there

    def error(self, position: Sequence[float] | F64) -> float:
        """Return how far from a position the hand ends up [m].

        Args:
            position: The position, (3,) [m]; how far it is outside the map is added.
        """
        place = (np.asarray(position) - self.origin) / _CELL
        last = np.array(self.errors.shape) - 1
        inside = np.minimum(np.maximum(place, 0.0), last)
        low = np.minimum(inside.astype(np.int64), last - 1)
        (x, y, z), (fx, fy, fz) = low.tolist(), (inside - low).tolist()
        block = self.errors[x : x + 2, y : y + 2, z : z + 2]
        block = block[0] + fx * (block[1] - block[0])
        block = block[0] + fy * (block[1] - block[0])
        return float(block[0] + fz * (block[1] - block[0])) + _CELL * float(
            np.abs(place - inside).max()
        )

    def has(self, position: Sequence[float] | F64) -> bool:
        """Return whether the hand reaches all corners of the map's cell that contains a position.

        Args:
            position: The position, (3,) [m].
        """
        offsets = zip(position, self.origin.tolist(), strict=True)
        cell = tuple(math.floor((at - first) / _CELL) for at, first in offsets)
        return min(cell) >= 0 and all(map(lt, cell, self.arrives.shape)) and self.arrives.item(cell)

    def has_each(self, points: F64) -> NDArray[np.bool_]:
        """Return `has` for each of N points, (N, 3) [m]; (N,)."""
        index = np.floor((points - self.origin) / _CELL).astype(np.int64)
        last = np.array(self.arrives.shape) - 1
        inside = ((index >= 0) & (index <= last)).all(axis=1)
        return inside & self.arrives[tuple(index.clip(0, last).T)]

    def nearly(self, position: Sequence[float] | F64) -> bool:
        """Return whether the hand gets near enough to a position for a label to make sense.

        Args:
            position: The position, (3,) [m].
        """
        return self.has(position) or self.error(position) < STRETCH

    def lean(self, position: Sequence[float] | F64) -> float:
        """Return how much the hand must lean to reach a position, from 0 (pointing down) to 1.

        Args:
            position: The position, (3,) [m].
        """
        if self.has(position):
            return 0.0
        return min(1.0, max(0.0, (self.error(position) - ARRIVES) / (STRETCH - ARRIVES)))

    def leaning(self, position: Sequence[float] | F64) -> bool:
        """Return whether a hand that may lean gets near `position` (3,) [m], by a rule of thumb.

        The downward hand must get near it, or near the point up to 13 cm closer, horizontally, to
        the map's centre.
        """
        if self.nearly(position):
            return True
        x, y, z = position
        in_x, in_y, _ = (self.origin + _CELL / 2 * (np.array(self.errors.shape) - 1)).tolist()
        inwards = _LEAN / max(_LEAN, math.hypot(in_x - x, in_y - y))
        return self.nearly((x + inwards * (in_x - x), y + inwards * (in_y - y), z))


@cache
def reach_of(robot: Robot) -> Reach:
    """Return a robot's map, from its file if there is one.

    Otherwise it is computed, which takes some seconds, and stored if possible.
    """
    path = _place(robot)
    # other files raise many kinds of errors
    with contextlib.suppress(Exception), open_outside(path, "a map") as file:
        kept = np.load(file)
        return Reach(kept["origin"].astype(np.float64), kept["errors"].astype(np.float64))
    reach, partial = _solve(robot), path.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb", opener=without_link) as file:
            np.savez_compressed(file, origin=reach.origin, errors=reach.errors.astype(np.float32))
        partial.replace(path)
    return reach


def _place(robot: Robot) -> Path:
    """Path of a map: beside the YAML of a robot that ships, whatever its servos, else in the
    cache.
    """
    for name in ROBOTS:
        if replace(robot, name=name, servos={}) == get_robot(name):
            return HERE / f"{name}.reach.npz"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "manip_il" / f"{robot.name}.reach.{_key(robot)}.npz"


def _key(robot: Robot) -> str:
    """Hash what a map depends on: the constants of this file, the YAML, and the robot's model as
    it is compiled.
    """
    constants = (_VERSION, _CELL, _BEYOND, _ABOVE, _STEPS, _NEAR, _ANGLE, _BLOCKED, CLEARANCE)
    compiled = model_bytes(arm_spec(robot).compile())
    # paths do not count
    said = replace(robot, files=ModelFiles(Path()), gripper=replace(robot.gripper, files=None))
    return hashlib.sha256(repr((constants, said)).encode() + compiled).hexdigest()[:16]


def _solve(robot: Robot) -> Reach:
    """Compute the map: how far from every point of the grid the hand ends."""
    # mink is slow to import, and a stored map does not need it
    from manip_il.robots.ik import ArmIK

    ik = ArmIK(robot)
    body = Body(robot)
    space = robot.workspace
    half = space.half_width + _BEYOND
    origin = np.array([space.centre[0] - half, space.centre[1] - half, 0.0])
    shape = tuple(round(size / _CELL) + 1 for size in (2 * half, 2 * half, space.height + _ABOVE))
    errors = np.empty(shape, np.float32)
    for index in np.ndindex(*shape):
        point = origin + _CELL * np.array(index)
        point[2] = max(point[2], robot.ee.lowest)  # no hand reaches the table itself
        miss, q = _miss(robot, ik, point)
        errors[index] = miss + (_BLOCKED if miss < _BLOCKED and body.meets_itself(q) else 0.0)
    return Reach(origin, errors.astype(np.float64))


def _miss(robot: Robot, ik: ArmIK, position: F64) -> tuple[float, F64]:
    """Return the pose error [m] at which inverse kinematics from home stops, and its last joints,
    (arm,) [rad].

    The error includes the angle, converted to a length.
    """
    yaw = ik.ahead(position)
    q = np.asarray(robot.home, dtype=np.float64)
    low, high = ik.limits.T
    down, miss = hand_down(yaw), np.inf
    for _ in range(_STEPS):
        ee, rotation = ik.ee_pose(q)
        angle = angle_between(down, rotation)
        if robot.leans:  # such an arm may lean by `_MOST_LEAN`
            angle = off_yaw(rotation, yaw) + max(0.0, angle_off_vertical(rotation) - _MOST_LEAN)
        miss = float(np.linalg.norm(position - ee) + _ANGLE * angle)
        if miss < _NEAR:
            break
        dq = ik.displacement(position, down, robot.max_joint_step)
        if dq is None or np.abs(dq).max() < 1e-5:
            break
        q = np.minimum(np.maximum(q + dq, low), high)
    return miss, q
