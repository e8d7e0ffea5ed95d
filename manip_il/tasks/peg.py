"""Grips of a peg that stands, lies or is held, as pure geometry of a world."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manip_il.robots.reach import ARRIVES, reach_of
from manip_il.robots.rotations import angle_between
from manip_il.sim.world import Scene, World
from manip_il.tasks.grasp import OPEN_SLACK, lie_of

F64 = NDArray[np.float64]

PEG, HOLE = "peg", "hole"
_OPEN_SHARE = 0.85  # share of the gripper's opening beyond the peg, if that is less than the slack
FROM_END = 0.04  # distance of the grip from the peg's upper end [m]
LOWEST = 0.024  # least height of the hand over the table at a lying peg [m]
BACK = 0.05  # distance behind the hand of a point: the peg's end that is nearer to it is the upper one [m]
STANDS = 0.4  # tilt below which the peg stands and is grasped from above [rad]
LEAN = math.radians(69)  # lean of the hand back over a lying peg's outer end, which leaves less to turn [rad]
LEAN_BY_ROOM = 3.0  # limit of that lean per spare reach, as the wrist is farther out [rad/m]
AT_GRIP, CLOSING = (0.012, 0.012, 0.012), (0.016, 0.020, 0.016)  # error at which to close, to keep closing [m]
AT_ANGLE = 0.25  # [rad]
OVER, SLOPE, FREE = 0.065, 2.0, 0.006  # height over the grip on approach [m]; per error; tolerated error [m]
BARE = 0.012  # how far a hand that holds the peg may be from its faces and ends [m]
ASLANT = 0.75  # angle to the peg's axis above which the hand must set the peg up before carrying it [rad]


class Grip(NamedTuple):
    """Grip of the hand on the peg: pose of `ee`, position (3,) [m] and rotation (3, 3).

    off: misalignment of the hand, angle included [m]; angle: to that pose [rad]; height: over the grip that this
    requires [m]. open_enough: the fingers pass on both sides of the peg.
    """

    position: F64
    rotation: F64
    off: float
    angle: float
    height: float
    open_enough: bool


def hand_at(yaw: float, pitch: float) -> F64:
    """Return rotation of `ee` with the hand pointing down at 0 `pitch`, and along `yaw` at a quarter turn; (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    along, up = np.array([c, s, 0.0]), np.array([0.0, 0.0, 1.0])
    z = math.sin(pitch) * along - math.cos(pitch) * up
    x = math.cos(pitch) * along + math.sin(pitch) * up
    return np.array([x, [s, -c, 0.0], z]).T


def azimuth(rotation: F64) -> float:
    """Return the `hand_at` yaw of a hand (3, 3) whose fingers move level, whatever its pitch [rad]."""
    return math.atan2(rotation[0, 1], -rotation[1, 1])


def lower_end(world: World) -> F64:
    """Return the middle of the peg's lower end, (3,) [m]."""
    peg = world.pose(PEG)
    axis = peg.rotation[:, 2]
    return peg.position - math.copysign(world.extents(PEG)[2] / 2, axis[2]) * axis


def upper_axis(world: World) -> F64:
    """Return the direction along the peg to its intended upper end, (3,)."""
    return world.remember("upper", lambda: _upper_axis(world))


def _upper_axis(world: World) -> F64:
    """Upper end of a held peg: the one that the hand points away from; of a lying peg: the one away from the robot."""
    peg, ee = world.pose(PEG), world.ee
    axis = peg.rotation[:, 2]
    if stands(world):
        return math.copysign(1.0, axis[2]) * axis
    if held(world):
        from_peg = ee.position - peg.position - BACK * ee.rotation[:, 2]
        return math.copysign(1.0, float(axis @ from_peg)) * axis
    at = azimuth(ee.rotation)
    return min((axis, -axis), key=lambda a: _far_turn(math.atan2(a[1], a[0]), at))


def _far_turn(yaw: float, at: float) -> float:
    """Cost of a yaw, by its distance from the hand's and from straight ahead [rad]."""
    return abs(yaw - at) + 0.5 * abs(yaw)


def stands(world: World) -> bool:
    """Return whether the peg stands, or nearly so, and is grasped from above."""
    return abs(world.pose(PEG).rotation[2, 2]) > math.cos(STANDS)


def held(world: World) -> bool:
    """Return whether both fingers touch the peg, and the hand is between its faces and its ends."""
    return world.remember("held", lambda: world.touched(PEG) and _around(world))


def _around(world: World) -> bool:
    peg = world.pose(PEG)
    x, y, z = np.abs(peg.rotation.T @ (world.ee.position - peg.position)).tolist()
    side, _, length = world.extents(PEG)
    return max(x, y) < side / 2 + BARE and z < length / 2 + BARE


def is_aslant(world: World) -> bool:
    """Return whether the hand is too oblique to the peg to carry it into a hole."""
    return -float(upper_axis(world) @ world.ee.rotation[:, 2]) < math.cos(ASLANT)


def grip_of(world: World) -> Grip:
    """Return how the hand grips the peg as it lies or stands; computed once per state."""
    return world.remember("grip", lambda: _grip(world))


def _grip(world: World) -> Grip:
    ee, peg = world.ee, world.pose(PEG)
    width, _, length = world.extents(PEG)
    axis = upper_axis(world)
    position = peg.position + (length / 2 - FROM_END) * axis
    if stands(world):
        at = azimuth(ee.rotation)
        yaw = min((grasp[0] for grasp in lie_of(world, PEG).grasps), key=lambda yaw: _far_turn(yaw, at))
        rotation = hand_at(yaw, 0.0)
    else:
        room = _farthest(world.scene) - position[0]
        lean = min(LEAN, LEAN_BY_ROOM * max(0.0, room))
        rotation = hand_at(math.atan2(axis[1], axis[0]), -lean)
    position = np.array([*position[:2], max(position[2], LOWEST)])
    angle = angle_between(ee.rotation, rotation)
    off = math.hypot(*(position - ee.position)[:2]) + 0.05 * max(0.0, angle - 0.1)
    height = min(OVER, SLOPE * max(0.0, off - FREE))
    slack = min(OPEN_SLACK, _OPEN_SHARE * (world.gripper.most - width))
    return Grip(position, rotation, off, angle, height, world.opening >= width + slack)


@lru_cache(8)
def _farthest(scene: Scene) -> float:
    """Farthest x at which the hand reaches the table [m]."""
    x, y = scene.robot.workspace.centre
    while reach_of(scene.robot).error((x + 0.01, y, 0.0)) < ARRIVES:
        x += 0.01
    return x
