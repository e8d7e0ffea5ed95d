"""A peg: grip it, set it upright, release and catch it, and move it.

The ladder and progress of tasks with a peg.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import (
    angle_across,
    angle_between,
    rotation_matrix,
    rotation_vector,
    turn_about_z,
)
from manip_il.robots.reach import ARRIVES, reach_of
from manip_il.sim.scene import SCENES_KEPT
from manip_il.sim.task import Rung, Target
from manip_il.sim.world import Scene, World
from manip_il.tasks.grasp import OPEN_SLACK, is_inside, lie_of, once_per_state, share
from manip_il.tasks.ladder import CLOSED, LiftProfile, nearness, rise_first

PEG, HOLE = "peg", "hole"
SIDE, LENGTH = 0.058, 0.10  # of the peg [m]
# least opening beyond the peg, as a share of the most possible, if less than `OPEN_SLACK`
_OPEN_SHARE = 0.85
FROM_END = 0.04  # distance of the grip from the peg's upper end [m]
LOWEST = 0.024  # least height of the hand over the table at a lying peg [m]
# a held peg's upper end is the one nearer to a point that is this far behind the hand [m]
BACK = 0.05
STANDS = 0.4  # tilt below which the peg stands and is grasped from above [rad]
# lean of the hand back over a lying peg's outer end, which leaves less to turn [rad]
LEAN = math.radians(69)
# largest lean per distance to the end of the arm's reach: leaning moves the wrist outwards [rad/m]
LEAN_BY_ROOM = 3.0
# errors up to which to close, to keep closing [m]
AT_GRIP, CLOSING = (0.012, 0.012, 0.012), (0.016, 0.020, 0.016)
AT_ANGLE = 0.25  # angle to the grip up to which to close [rad]
OVER = 0.065  # greatest height over the grip on approach [m]
# height over the grip, by the hand's misalignment
FUNNEL = LiftProfile(OVER, slope=2.0, free=0.006)
BARE = 0.012  # how far outside the peg's faces and ends a hand that holds it may be [m]
# angle to the peg's axis above which the hand must set the peg up before carrying it [rad]
ASLANT = 0.75
LIFT, LIFT_SLOPE = 0.015, 2.5  # height of the peg's lower end over the rim [m]; height per error
ANGLE_AS_LENGTH = 0.03  # what a radian counts for in these errors [m/rad]
# how far ahead of the hand its target runs, at the rim and far from it [m]
SLOW, FAST = 0.010, 0.06
# factor on the distance that an exact move aims for, because the arm's weight stops it short
FARTHER = 1.5
# how far the target's rotation runs ahead of the hand's, while the hand also moves [rad]
TURN = 0.15
# opening beyond the peg's width at which the peg is free, and the one commanded [m]
LET_GO, RELEASE = 0.012, 0.03
CLEAR = 0.03  # clearance of the hand over the peg after release [m]
# range of yaw, to either side, at which the hand sets the peg up [rad]
ASIDE = (math.radians(55), math.radians(70))
# largest distance from the workspace's middle along x at which the peg is set up [m]
NEAR_MIDDLE = 0.05
FROM_HOLE = 0.11  # least distance from the hole at which the peg is set up [m]
OVER_WALLS = 0.03  # how much higher the peg is carried beside the hole [m]
SET_DOWN = 0.010  # error at which the peg is down on the table [m]
ON_TABLE = 0.004  # height of the lower end over the table at which the peg stands [m]
# least height of a falling peg; largest distance of its axis from the hand [m]
IN_AIR, BESIDE = 0.006, 0.045


class Grip(NamedTuple):
    """Grip that the hand aims for, and how far the hand is from it.

    Attributes:
        position: The position of `ee`, (3,) [m].
        rotation: The rotation of `ee`, (3, 3).
        off: The misalignment of the hand, distance and angle as one length [m].
        angle: The angle between the rotations of the hand and the grip [rad].
        height: The distance to keep above the grip, which grows with the misalignment [m].
        open_enough: Whether the fingers pass on both sides of the peg.
    """

    position: F64
    rotation: F64
    off: float
    angle: float
    height: float
    open_enough: bool


def hand_at(yaw: float, pitch: float) -> F64:
    """Return the rotation of `ee`, (3, 3), at a yaw and a pitch [rad].

    The hand points down at a pitch of 0, and level along `yaw` at a pitch of pi/2.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    level, upright = math.cos(pitch), math.sin(pitch)
    x = [level * c, level * s, upright]
    return np.array([x, [s, -c, 0.0], [upright * c, upright * s, -level]]).T


def lower_end(world: World) -> F64:
    """Return the middle of the peg's lower end, (3,) [m]."""
    peg = world.pose(PEG)
    axis = peg.rotation[:, 2]
    return peg.position - math.copysign(LENGTH / 2, axis[2]) * axis


@once_per_state
def upper_axis(world: World) -> F64:
    """Return the direction along the peg to its intended upper end, (3,).

    For a standing peg this is the end on top; for a held peg, the end that the hand points away
    from; for a lying peg, the end whose yaw is closer to the hand's and to straight ahead.
    """
    peg, ee = world.pose(PEG), world.ee
    axis = peg.rotation[:, 2]
    if stands(world):
        upwards = axis[2]
    elif holds_peg(world):
        upwards = axis @ (ee.position - peg.position - BACK * ee.rotation[:, 2])
    else:
        return min((axis, -axis), key=lambda a: _far_turn(world, math.atan2(a[1], a[0])))
    return math.copysign(1.0, upwards) * axis


def _far_turn(world: World, yaw: float) -> float:
    """Cost of a yaw, by its distance from the hand's and from straight ahead [rad]."""
    return abs(yaw - angle_across(world.ee.rotation)) + 0.5 * abs(yaw)


def stands(world: World) -> bool:
    """Return whether the peg stands, or nearly so, and is therefore grasped from above."""
    return abs(world.pose(PEG).rotation[2, 2]) > math.cos(STANDS)


@once_per_state
def holds_peg(world: World) -> bool:
    """Return whether the hand holds the peg.

    Both fingers touch the peg, and the hand is within the peg's faces and ends or just outside.
    """
    peg = world.pose(PEG)
    x, y, z = np.abs(peg.rotation.T @ (world.ee.position - peg.position))
    return max(x, y) < SIDE / 2 + BARE and z < LENGTH / 2 + BARE and world.touched(PEG)


def is_aslant(world: World) -> bool:
    """Return whether the hand is too oblique to the peg to carry it into a hole."""
    return -float(upper_axis(world) @ world.ee.rotation[:, 2]) < math.cos(ASLANT)


@once_per_state
def grip_of(world: World) -> Grip:
    """Return the grip that the hand aims for, given how the peg stands or lies."""
    ee, axis = world.ee, upper_axis(world)
    position = world.at(PEG) + (LENGTH / 2 - FROM_END) * axis
    yaw, pitch = math.atan2(axis[1], axis[0]), 0.0
    if stands(world):
        yaws = [yaw for yaw, _, _, _ in lie_of(world, PEG).grasps]
        yaw = min(yaws, key=lambda yaw: _far_turn(world, yaw))
    else:
        room = _farthest(world.scene) - position[0]
        pitch = -min(LEAN, LEAN_BY_ROOM * max(0.0, room))
    rotation = hand_at(yaw, pitch)
    position[2] = max(position[2], LOWEST)
    angle = angle_between(ee.rotation, rotation)
    off = math.hypot(*(position - ee.position)[:2]) + 0.05 * max(0.0, angle - 0.1)
    slack = min(OPEN_SLACK, _OPEN_SHARE * (world.gripper.most - SIDE))
    return Grip(position, rotation, off, angle, FUNNEL.over(off), world.opening >= SIDE + slack)


@lru_cache(SCENES_KEPT)
def _farthest(scene: Scene) -> float:
    """Farthest x at which the hand reaches the table [m]."""
    x, y = scene.robot.workspace.centre
    while reach_of(scene.robot).error((x + 0.01, y, 0.0)) < ARRIVES:
        x += 0.01
    return x


class Motion(NamedTuple):
    """Remaining motion of a held peg.

    Attributes:
        rotation: The hand's rotation once the peg is upright and, if it goes into the hole, aligned
            with the hole, (3, 3).
        turn: The remaining rotation vector of the hand, (3,) [rad].
        angle: The length of `turn` [rad].
        off: The remaining horizontal offset, (2,) [m].
        distance: The length of `off` [m].
        error: `distance` and `angle` as one length [m].
        low: The height of the peg's lower end over the table once the peg is upright [m].
    """

    rotation: F64
    turn: F64
    angle: float
    off: F64
    distance: float
    error: float
    low: float


@once_per_state
def to_stand(world: World) -> Motion:
    """Return the remaining motion of a held peg that must stand on the table first.

    The peg turns upright by the smallest rotation, and the hand turns to one side. The peg's place
    is near the workspace's middle along x, and away from the hole.
    """
    hand, axis = world.ee.rotation, upper_axis(world)
    upright = _upright(axis) @ hand
    y, at = world.ee.position[1] - world.robot.workspace.centre[1], angle_across(hand)
    least, most = ASIDE
    yaw = min(
        (math.copysign(min(most, max(least, side * at)), side) for side in (1.0, -1.0)),
        key=lambda yaw: abs(yaw - at) + 8.0 * max(0.0, math.copysign(y, yaw * y)),
    )
    return motion_to(world, turn_about_z(yaw - angle_across(upright)) @ upright, _free_place)


def _upright(axis: F64) -> F64:
    """The smallest rotation that turns an axis up, (3, 3)."""
    x, y, z = axis
    if z < -0.99:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def _free_place(world: World, end: F64) -> F64:
    """Place (3,) [m] on the table to set the peg up, nearest to where its lower end (3,) would
    be.
    """
    middle = world.robot.workspace.centre[0]
    x = min(middle + NEAR_MIDDLE, max(middle - NEAR_MIDDLE, end[0]))
    at = np.array([x, end[1], 0.0])
    from_hole = at - world.at(HOLE)
    return at + max(0.0, FROM_HOLE / max(math.hypot(*from_hole[:2]), 1e-6) - 1) * from_hole


def motion_to(world: World, rotation: F64, to: Callable[[World, F64], F64]) -> Motion:
    """Return the motion that is left if the hand turns with the peg to a rotation.

    Args:
        world: The world to look at.
        rotation: The rotation of the hand once the peg is upright, (3, 3).
        to: Returns the target of the peg's lower end, (3,) [m], given the world and where the turn
            alone would bring this end, (3,) [m].
    """
    ee, peg = world.ee, world.pose(PEG)
    turn = rotation_vector(rotation @ ee.rotation.T)
    end = peg.position - LENGTH / 2 * upper_axis(world)
    # the lower end, once the peg is upright
    turned = ee.position + rotation @ (ee.rotation.T @ (end - ee.position))
    off = (to(world, turned) - turned)[:2]
    angle, distance = math.hypot(*turn), math.hypot(*off)
    error = distance + ANGLE_AS_LENGTH * angle
    return Motion(rotation, turn, angle, off, distance, error, turned[2])


def _set_up(world: World) -> Target:
    """Lift the peg and turn it upright over a free place, then lower it to the table."""
    motion = to_stand(world)
    return move(world, motion, _set_up_height(world) - motion.low, sideways_at=0.03)


def _set_up_height(world: World) -> float:
    """Target height of the lower end over the table, greater near the walls of the hole [m]."""
    room = math.dist(world.at(PEG)[:2], world.at(HOLE)[:2]) - FROM_HOLE
    most = LIFT + OVER_WALLS * share(1 - room / OVER_WALLS)
    # without the hand's yaw, which may be out of reach
    tilt = math.acos(min(1.0, upper_axis(world)[2]))
    error = to_stand(world).distance + ANGLE_AS_LENGTH * tilt
    return min(most, LIFT_SLOPE * max(0.0, error - SET_DOWN)) - 0.001


def move(
    world: World, motion: Motion, missing: float, sideways_at: float, exact: bool = False
) -> Target:
    """Return the target that moves the held peg with the hand.

    Args:
        world: The world to look at.
        motion: The motion that is left.
        missing: The height that the peg's lower end must still gain, negative if it must sink [m].
        sideways_at: The missing height below which the peg also moves sideways [m].
        exact: Whether the hand must be placed exactly, see `Target`.
    """
    sideways = share(1.0 - missing / sideways_at)
    turn = TURN * min(1.0, max(0.25, 1.0 - missing / 0.06))
    rotation = motion.rotation
    if exact:
        sideways *= FARTHER
        rotation = rotation_matrix((FARTHER - 1) * motion.turn) @ rotation
    position = world.ee.position + np.append(sideways * motion.off, max(missing, -SLOW))
    step = min(FAST, SLOW + max(0.0, motion.error - 0.02))
    return Target(position, rotation, CLOSED, max_step=step, max_turn=turn, exact=exact)


def is_up(world: World) -> bool:
    """Return whether the peg stands on the table, with an oblique hand at it or just above it."""
    end = lower_end(world)
    x, y, z = world.ee.position - end
    up = upper_axis(world)[2] > math.cos(0.15) and end[2] < ON_TABLE
    return up and is_aslant(world) and math.hypot(x, y) < 0.03 and z < LENGTH + CLEAR


def _let_stand(world: World) -> Target:
    """Open the fingers, then rise straight up."""
    free = world.opening > SIDE + LET_GO and not world.touched(PEG)
    up = [0.0, 0.0, 0.1 if free else 0.0]
    opening = min(SIDE + RELEASE, world.gripper.most)
    return Target(world.ee.position + up, world.ee.rotation, opening, max_step=0.04)


def _falls(world: World) -> bool:
    """Whether the peg, between the fingers or just under their tips, neither stands nor lies."""
    peg, lie = world.pose(PEG), lie_of(world, PEG)
    axis, way = peg.rotation[:, 2], world.ee.position - peg.position
    along = float(axis @ way)
    beside = world.ee.rotation.T @ (way - along * axis)
    between = abs(beside[1]) < world.opening / 2 and math.hypot(*beside) < BESIDE
    moves = lie.tilt > 0.06 or peg.position[2] - lie.tall / 2 > IN_AIR
    return between and abs(along) <= LENGTH / 2 and moves


def _catch(world: World) -> Target:
    """Close the fingers and follow the peg."""
    ee, axis = world.ee, upper_axis(world)
    along = axis @ (ee.position - world.at(PEG))
    down = (LENGTH / 2 - FROM_END - along) * axis
    return Target(ee.position + down, ee.rotation, CLOSED)


def _at_grip(world: World) -> bool:
    grip = grip_of(world)
    box = AT_GRIP if grip.open_enough else CLOSING
    offset = grip.rotation.T @ (world.ee.position - grip.position)
    return is_inside(offset, box) and grip.angle < AT_ANGLE


def _approach(world: World) -> Target:
    """Move over the grip and down to it, fingers open; a hand too low beside it only rises."""
    grip = grip_of(world)
    up = [0.0, 0.0, grip.height if grip.open_enough else OVER]
    at = rise_first(world.ee.position, grip.position + up)
    return Target(at, grip.rotation, world.gripper.most, max_turn=TURN)


def hangs(world: World) -> bool:
    """Return whether the peg hangs from a hand that points along it, more or less."""
    return holds_peg(world) and not is_aslant(world) and stands(world)


def peg_progress(world: World) -> float:
    """Return progress of gripping a peg from above, 0 to 1.

    A peg that lies must first be set up.
    """
    grip = grip_of(world)
    above = world.ee.position[2] - grip.position[2]
    if is_up(world):
        return 0.55 + 0.11 * share(above / (FROM_END + CLEAR))
    if holds_peg(world):
        motion, height = to_stand(world), _set_up_height(world)
        rest = motion.distance + abs(height - motion.low) + height + 0.25 * motion.angle
        return 0.33 + 0.2 * nearness(rest)
    near = nearness(grip.off + abs(above - grip.height) + grip.height)
    return 0.68 + 0.31 * near if stands(world) else 0.3 * near


PEG_RUNGS = (
    Rung("let_stand", is_up, _let_stand),
    Rung("set_up", holds_peg, _set_up),
    Rung("catch", _falls, _catch),
    Rung("grasp", _at_grip, lambda w: Target(grip_of(w).position, grip_of(w).rotation, CLOSED)),
    Rung("open", lambda w: not grip_of(w).open_enough, _approach),
    Rung("descend", lambda w: grip_of(w).height < OVER, _approach),
    Rung("approach", lambda w: True, _approach),
)
