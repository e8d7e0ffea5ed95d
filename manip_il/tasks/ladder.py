"""Rungs that tasks share: how a hand gets around an object, holds it and carries it, as pure geometry of a world.

Within a rung targets are continuous in the state, and the approach is one funnel rather than waypoints: the nearer the
hand is to being over the object, the lower it may go. Neighbouring states then have neighbouring labels, which a
learner can fit. Whether an object is held is read off the fingers that touch it; nothing is stored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import World
from manip_il.tasks.task import Rung, Target

F64 = NDArray[np.float64]

HOVER = 0.055  # of the hand over the object's top while it is not above it [m]
CLEAR = 0.03  # of the hand over the object's top: the fingertips are above it [m]
FUNNEL_RADIUS = 0.010  # misalignment at which the hand may be all the way down [m]
FUNNEL_SLOPE = 2.0  # height the hand gains per misalignment beyond it
ANGLE_AS_LENGTH = 0.05  # how much misalignment a radian of wrong orientation counts for [m/rad]
ANGLE_FREE = 0.1  # orientation error that counts for nothing [rad]
TIGHT = 0.35  # share of the room beside an object that fills the hand which misalignment may take
RISE_FIRST = 0.03  # this far under the funnel, the hand only rises [m]
LOWEST_EE = 0.021  # of the ee site over the table: the fingertips just clear it [m]
AT_GRASP = (0.015, 0.015, 0.015)  # object's centre in the ee frame, x y z: start to close [m]
AT_GRASP_ANGLE = 0.3  # [rad]
CLOSING = (0.022, 0.015, 0.022)  # the same once they have begun to close [m]
IN_HAND = (
    0.009,
    0.020,
    0.011,
)  # object's centre in the ee frame, in x and z beyond half its size: between the fingers [m]
OPEN_SLACK = 0.016  # opening beyond the object's width at which the hand may descend, where there is so much [m]
OPEN_SHARE = 0.6  # of what the gripper opens beyond the object's width
PREFER_ZERO = 0.3  # weight of a grasp's own yaw against its distance from the hand's
MAX_TILT = 0.3  # of the object off a face: wait over it until it has settled [rad]
CARRY_LIFT = 0.05  # of the object over the goal's height on the way there [m]
CARRY_SLOPE = 0.6  # lift per horizontal distance still to go
CARRY_FREE = 0.015  # horizontal distance at which no lift is left [m]
AT_GOAL = 0.01  # [m]
CLOSED = 0.0  # commanded opening of a hand that grips [m]
_HALFWAY = 0.2  # way still to go at which half of a part's progress is made [m]
_GRASPED = 0.5  # progress of an object that is held


class Grasp(NamedTuple):
    """An object as the hand sees it.

    offset: its centre in the `ee` frame [m]. width, half: of it between the fingers, and half its height [m].
    tilt: off the nearest face [rad]. yaw: of a hand that points down to grasp it; angle: how far the hand is from that
    [rad].
    at: where `ee` grasps it [m]. open_enough: the fingers pass on both sides of it. off: how far the hand is from being
    over it, its angle counted in [m]; height: how high over `at` it must be for that [m].
    """

    offset: tuple[float, ...]
    width: float
    half: float
    tilt: float
    yaw: float
    angle: float
    at: tuple[float, float, float]
    open_enough: bool
    off: float
    height: float


def grasp_of(world: World, name: str) -> Grasp:
    """Return the pose of an object relative to the hand; computed once a state."""
    return world.remember(("grasp", name), partial(_grasp, world, name))


def _grasp(world: World, name: str) -> Grasp:
    ee, pose, (width, _, tall) = world.ee, world.pose(name), world.extents(name)
    cube, tilt = cube_yaw(pose.rotation)
    yaw = grasp_yaw(cube, ee.rotation)
    angle = angle_from_down(ee.rotation, yaw)
    x, y, z = pose.position.tolist()
    ee_x, ee_y, ee_z = ee.position.tolist()
    dx, dy, dz = x - ee_x, y - ee_y, z - ee_z
    room = max(0.0, world.most_opening - width)  # what the open gripper leaves beside it [m]
    free = min(ANGLE_FREE, TIGHT * room / width)
    off = math.hypot(dx, dy) + ANGLE_AS_LENGTH * max(0.0, angle - free)
    return Grasp(
        offset=tuple(a * dx + b * dy + c * dz for a, b, c in ee.rotation.T.tolist()),
        width=width,
        half=tall / 2,
        tilt=tilt,
        yaw=yaw,
        angle=angle,
        at=(x, y, max(z, LOWEST_EE)),
        open_enough=world.opening >= width + min(OPEN_SLACK, OPEN_SHARE * room),
        off=off,
        height=min(tall / 2 + HOVER, FUNNEL_SLOPE * max(0.0, off - min(FUNNEL_RADIUS, TIGHT * room))),
    )


def held(world: World, name: str) -> bool:
    """Return whether the object is between the fingers and each of them touches it."""
    g = grasp_of(world, name)
    x, y, z = IN_HAND
    return _inside(g.offset, (g.width / 2 + x, y, g.half + z)) and world.touched(name)


def at_grasp(world: World, name: str) -> bool:
    """Return whether closing the fingers now would hold the object; with hysteresis once they have begun to close."""
    g = grasp_of(world, name)
    box = AT_GRASP if g.open_enough else CLOSING
    return _inside(g.offset, box) and g.angle < AT_GRASP_ANGLE and g.tilt < MAX_TILT


def approach(world: World, name: str) -> Target:
    """Approach from above: over the object and down around it, fingers open; straight up if too low beside it."""
    g, (ee_x, ee_y, ee_z) = grasp_of(world, name), world.ee.position.tolist()
    x, y, z = g.at
    height = g.height if g.open_enough and g.tilt < MAX_TILT else max(g.height, g.half + CLEAR)
    too_low = z + height - ee_z
    sideways = min(1.0, max(0.0, 1.0 - too_low / RISE_FIRST))
    position = np.array([ee_x + sideways * (x - ee_x), ee_y + sideways * (y - ee_y), z + height])
    return Target(position, hand_down(g.yaw), world.most_opening)


def close_on(world: World, name: str) -> Target:
    """Close the fingers at the object's position."""
    g = grasp_of(world, name)
    return Target(np.array(g.at), hand_down(g.yaw), CLOSED)


def carry(world: World, name: str, to: F64) -> Target:
    """Carry the held object's centre to a point (3,) [m], above it first and then down."""
    way = to - world.pose(name).position
    lift = carry_lift(math.hypot(way[0], way[1]))
    position = world.ee.position + way + [0.0, 0.0, lift]
    position[2] = max(position[2], LOWEST_EE)
    return Target(position, hand_down(0.0), CLOSED)


def carry_lift(distance: float) -> float:
    """Return how high over its goal an object is carried at a horizontal distance from it [m]."""
    return min(CARRY_LIFT, CARRY_SLOPE * max(0.0, distance - CARRY_FREE))


def pick_rungs(name: str) -> tuple[Rung, ...]:
    """Return the ladder that grasps an object and carries it to the goal."""

    def at_goal(world: World) -> bool:
        return held(world, name) and math.dist(world.pose(name).position, world.goal) < AT_GOAL

    def to_goal(world: World) -> Target:
        return carry(world, name, world.goal)

    def near(world: World) -> bool:
        g = grasp_of(world, name)
        return (max(g.height, g.half + CLEAR) if g.tilt >= MAX_TILT else g.height) < g.half + HOVER

    def approaching(world: World) -> Target:
        return approach(world, name)

    return (
        Rung("at_goal", "the object is in the hand, at the goal", at_goal, to_goal),
        Rung("carry", "the object is in the hand, on its way to the goal", lambda w: held(w, name), to_goal),
        Rung(
            "grasp",
            "the fingers are around the object and close, but do not hold it yet",
            lambda w: at_grasp(w, name),
            lambda w: close_on(w, name),
        ),
        Rung(
            "open",
            "the fingers are closed, or not open wide enough to go around the object",
            lambda w: not grasp_of(w, name).open_enough,
            approaching,
        ),
        Rung("descend", "the hand goes down to the object", near, approaching),
        Rung("approach", "the hand is on its way to above the object", lambda w: True, approaching),
    )


def pick_progress(world: World, name: str) -> float:
    """Return progress of grasping an object and carrying it to the goal, 0 to 1, by the way left on that path."""
    if held(world, name):
        way = world.goal - world.pose(name).position
        along = math.hypot(way[0], way[1])
        rest = along + abs(way[2] + carry_lift(along))
        return _GRASPED + (1 - _GRASPED) * nearness(rest)
    g = grasp_of(world, name)
    above = float(world.ee.position[2]) - g.at[2]
    return 0.9 * _GRASPED * nearness(g.off + abs(above - g.height) + g.height)


def nearness(rest: float) -> float:
    """Return 1 within `AT_GOAL` [m], and less the longer the way still to go is."""
    return _HALFWAY / (_HALFWAY + max(0.0, rest - AT_GOAL))


def hand_down(yaw: float) -> F64:
    """Return rotation of `ee` with the hand pointing down, turned by `yaw` [rad] about the world's z; (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def grasp_yaw(object_yaw: float, hand: F64) -> float:
    """Return the yaw of a cube's four grasps that is nearest to the hand's, with a small preference for 0 [rad].

    hand: rotation of `ee`, (3, 3). Nearest to the hand, not to zero: a learner that averages both sides of the boundary
    between two grasps then leaves it by any turn, and does not stand still in the middle.
    """
    at = math.atan2(hand[1, 0], hand[0, 0])
    quarter = math.pi / 2
    turns = (object_yaw - quarter, object_yaw, object_yaw + quarter)
    return min((abs(yaw - at) + PREFER_ZERO * abs(yaw), yaw) for yaw in turns)[1]


def cube_yaw(rotation: F64) -> tuple[float, float]:
    """Return a resting cube's yaw modulo a quarter turn, in [-pi/4, pi/4], and its tilt off a face [rad].

    A cube looks the same on every face, so the yaw is that of the side most along x or y once the axis
    nearest the vertical is set aside. rotation: of the cube, (3, 3).
    """
    ahead, left, vertical = rotation.tolist()
    heights = [abs(height) for height in vertical]
    up = heights.index(max(heights))
    side = (up + 1) % 3
    quarter = math.pi / 2
    yaw = math.atan2(left[side], ahead[side])
    yaw -= quarter * round(yaw / quarter)
    return yaw, math.acos(min(1.0, abs(vertical[up])))


def angle_from_down(rotation: F64, yaw: float) -> float:
    """Return `angle_between` a rotation (3, 3) and `hand_down(yaw)` [rad]."""
    (xx, xy, _), (yx, yy, _), (_, _, zz) = rotation.tolist()
    trace = math.cos(yaw) * (xx - yy) + math.sin(yaw) * (xy + yx) - zz
    return math.acos(min(1.0, max(-1.0, (trace - 1) / 2)))


def angle_between(a: F64, b: F64) -> float:
    """Return angle of the rotation from `a` to `b`, (3, 3) each [rad]."""
    return math.acos(min(1.0, max(-1.0, (float(a.ravel() @ b.ravel()) - 1) / 2)))


def _inside(offset: Sequence[float], box: tuple[float, float, float]) -> bool:
    return abs(offset[0]) <= box[0] and abs(offset[1]) <= box[1] and abs(offset[2]) <= box[2]
