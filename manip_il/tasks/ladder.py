"""Rungs that tasks share: how a hand closes around an object, holds it and carries it, as pure
geometry of a world.

Within a rung targets are continuous in the state, and the approach is one funnel rather than
waypoints: the nearer the hand is to being over the object, the lower it may go. Neighbouring states
then have neighbouring labels, which a learner can fit. The fingers' contacts show whether an object
is held; nothing is stored.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import hand_down
from manip_il.sim.task import Rung, Target
from manip_il.sim.world import World
from manip_il.tasks.grasp import CLOSING, HOVER, grasp_of, is_inside, lie_of, share

Which = Callable[[World], str]  # returns the current object's name
Place = Callable[[World], F64]  # returns the target of that object's centre, (3,) [m]

CLEAR = 0.03  # clearance of the hand over the object's top at which the fingertips are above it [m]
RISE_FIRST = 0.03  # a hand this far below its path only rises [m]
# bounds on the object's centre in the ee frame, x y z, to start closing [m]
AT_GRASP = (0.015, 0.015, 0.015)
AT_GRASP_ANGLE = 0.3  # [rad]
EMPTY = 0.4  # opening, as a share of a mesh's width, below which the fingers have missed it
# tolerated height over a mesh's grasp [m], and as a share of its height
LEAST_DEEP, DEEP_SHARE = 0.004, 0.15
# bounds on a held object's centre in the ee frame, x and z beyond half its size [m]
IN_HAND = (0.009, 0.020, 0.011)
RELEASE = 0.03  # how much wider than an object the hand opens to release it, if it can [m]
FREED = 0.4  # share of that extra opening at which the object is free
AT_GOAL = 0.01  # [m]
CLOSED = 0.0  # commanded opening of a hand that grips [m]
_HALFWAY = 0.2  # distance left at which half of a part's progress is made [m]


class LiftProfile(NamedTuple):
    """Height of a carried object over its goal, by the horizontal distance still to go.

    Attributes:
        most: The height far from the goal [m].
        slope: The height per metre of distance beyond `free`.
        free: The distance from the goal up to which the height is 0 [m].
        rise_first: An object this far below that height, or farther, only rises [m].
        max_step: How far a single step may aim, see `Target` [m].
    """

    most: float = 0.05
    slope: float = 0.6
    free: float = 0.015
    rise_first: float = math.inf
    max_step: float = 0.12

    def over(self, distance: float) -> float:
        """Return the height over the goal at a horizontal distance from it [m]."""
        return min(self.most, self.slope * max(0.0, distance - self.free))


OVER_NOTHING = LiftProfile()  # to a goal with nothing around it


def is_held(world: World, name: str) -> bool:
    """Return whether the object is between the fingers and each of them touches it."""
    x, y, z = IN_HAND
    half = max(world.extents(name)) / 2
    if math.dist(world.at(name).tolist(), world.ee.position.tolist()) > math.hypot(
        half + x, y, half + z
    ):
        return False  # too far away; grasps need not be computed
    if world.hull(name) is None:
        g = grasp_of(world, name)
        offset, box = g.offset, (g.length / 2 + x, y, g.half + z)
    else:  # a mesh may be at any rotation in the hand
        offset = (world.at(name) - world.ee.position).dot(world.ee.rotation).tolist()
        offset[1] -= world.gripper.middle(world.opening)
        box = (half + x, y, half + z)
    return is_inside(offset, box) and world.touched(name)


def at_grasp(world: World, name: str) -> bool:
    """Return whether closing the fingers now would hold the object.

    Bounds are wider once they have begun to close.
    """
    g = grasp_of(world, name)
    box = AT_GRASP if g.open_enough else CLOSING
    if world.hull(name) is not None:
        # A mesh's sides may be round: fingers that close too high slip off.
        deep = max(LEAST_DEEP, DEEP_SHARE * lie_of(world, name).tall)
        deep = deep if g.open_enough else 2 * deep
        if world.opening < EMPTY * g.width or world.ee.position[2] - g.at[2] > deep:
            return False
    return is_inside(g.offset, box) and g.angle < AT_GRASP_ANGLE and g.settled


def rise_first(at: F64, to: Sequence[float] | F64) -> F64:
    """Return the next target from a point (3,) towards another, (3,) [m].

    It is straight up if the point is far below the other.
    """
    (x, y, z), (to_x, to_y, to_z) = at.tolist(), to
    sideways = share(1.0 - (to_z - z) / RISE_FIRST)
    return np.array([x + sideways * (to_x - x), y + sideways * (to_y - y), to_z])


def approach(world: World, name: str, hover: float = 0.0, rise: float = 0.0) -> Target:
    """Return the target that brings the open hand over an object and down around it.

    A hand that is too low beside the object only rises.

    Args:
        world: The world to look at.
        name: The object's name.
        hover: The height over the grasp on the way there, if this is more than the height that
            clears the object's top [m].
        rise: The least height over the grasp [m].
    """
    g = grasp_of(world, name)
    x, y, z = g.at
    height = max(g.height, min(hover, g.funnel), rise)
    height = height if g.open_enough and g.settled else max(height, g.half + CLEAR)
    return Target(
        rise_first(world.ee.position, (x, y, z + height)), hand_down(g.yaw), g.wide, lean=g.lean
    )


def close_on(world: World, name: str) -> Target:
    """Close the fingers on the object, where it is."""
    g = grasp_of(world, name)
    at, hand = np.array(g.at), hand_down(g.yaw)
    # the moving jaw pushes the object to the fixed one; the hand does not follow
    if world.gripper.lopsided:
        across = hand[:, 1].copy()
        at += across * (across @ (world.ee.position - at))
    return Target(at, hand, CLOSED, lean=g.lean)


def carry(world: World, name: str, to: F64, lift: LiftProfile = OVER_NOTHING) -> Target:
    """Return the target that carries the held object over a point, then down to it.

    Args:
        world: The world to look at.
        name: The object's name.
        to: The target of the object's centre, (3,) [m].
        lift: The height of the object on its way there.
    """
    x, y, z = (to - world.at(name)).tolist()
    off = math.hypot(x, y)
    height = lift.over(off)
    sideways = share(1.0 - (z + height) / lift.rise_first) if off > lift.free else 1.0
    position = world.ee.position + [sideways * x, sideways * y, z + height]
    position[2] = max(position[2], world.robot.ee.lowest)
    return Target(position, hand_down(world.ahead(position)), CLOSED, max_step=lift.max_step)


def let_go(world: World, name: str, height: float) -> Target:
    """Open the fingers just enough to free an object, then rise straight up.

    Args:
        world: The world to look at.
        name: The object's name.
        height: The height of the hand over the object's centre to rise to [m].
    """
    g, ee = grasp_of(world, name), world.ee
    beyond = min(RELEASE, world.gripper.most - g.width)
    free = world.opening > g.width + FREED * beyond and not world.touched(name)
    at = ee.position.copy()
    if free:
        at[2] = world.at(name)[2] + height
    if world.gripper.lopsided:  # the fixed jaw must move off the object, too
        along = g.offset[1] + world.gripper.middle(g.width) - world.gripper.middle(g.width + beyond)
        at[:2] += along * ee.rotation[:2, 1]
    return Target(at, hand_down(world.hand_yaw), g.width + beyond)


def hand_is_at(world: World, name: str, aside: float, above: float) -> bool:
    """Return whether the hand is close to an object.

    Args:
        world: The world to look at.
        name: The object's name.
        aside: The upper bound on the hand's horizontal distance from the object's centre [m].
        above: The upper bound on the hand's height over the object's centre [m].
    """
    x, y, z = (world.ee.position - world.at(name)).tolist()
    return math.hypot(x, y) < aside and z < above


def grasp_rungs(
    which: Which, hover: float = 0.0, approach: Callable[[World, str, float], Target] = approach
) -> tuple[Rung, ...]:
    """Return the rungs that bring the fingers around an object and close them.

    Args:
        which: Returns the name of the object to grasp.
        hover: The height over the grasp on the way there, see `approach` [m].
        approach: Returns the target of the approach, given the world, the object's name and
            `hover`.

    Returns:
        The rungs `grasp`, `open`, `descend` and `approach`, in this order.
    """

    def near(world: World) -> bool:
        g = grasp_of(world, which(world))
        return g.height < g.half + HOVER

    def approaching(world: World) -> Target:
        return approach(world, which(world), hover)

    return (
        Rung("grasp", lambda w: at_grasp(w, which(w)), lambda w: close_on(w, which(w))),
        Rung("open", lambda w: not grasp_of(w, which(w)).open_enough, approaching),
        Rung("descend", near, approaching),
        Rung("approach", lambda w: True, approaching),
    )


def pick_rungs(name: str) -> tuple[Rung, ...]:
    """Return the ladder that grasps an object and carries it to the goal."""

    def at_goal(world: World) -> bool:
        return is_held(world, name) and math.dist(world.at(name), world.goal) < AT_GOAL

    def to_goal(world: World) -> Target:
        return carry(world, name, world.goal)

    return (
        Rung("at_goal", at_goal, to_goal),
        Rung("carry", lambda w: is_held(w, name), to_goal),
        *grasp_rungs(lambda w: name),
    )


def grasp_progress(world: World, name: str, hover: float = 0.0, rise: float = 0.0) -> float:
    """Return how far the fingers have come on their way around an object, 0 to 1.

    It depends on the distance left on the path of `approach`.

    Args:
        world: The world to look at.
        name: The object's name.
        hover: The height over the grasp on the way there, see `approach` [m].
        rise: The least height over the grasp [m].
    """
    g = grasp_of(world, name)
    above = world.ee.position[2] - g.at[2]
    height = max(g.height, min(hover, g.funnel), rise)
    return nearness(g.off + abs(above - height) + height)


def pick_progress(world: World, name: str) -> float:
    """Return how far an object has come on its way to the grasp and the goal, 0 to 1.

    It depends on the distance left on that path.
    """
    if is_held(world, name):
        return 0.5 + 0.5 * carry_progress(world, name, world.goal)
    return 0.45 * grasp_progress(world, name)


def carry_progress(world: World, name: str, to: F64, lift: LiftProfile = OVER_NOTHING) -> float:
    """Return how far a held object has come on its way to a point, 0 to 1.

    It depends on the distance left on the path of `carry`, which goes up, sideways, and down.

    Args:
        world: The world to look at.
        name: The object's name.
        to: The target of the object's centre, (3,) [m].
        lift: The height of the object on its way there.
    """
    x, y, z = to - world.at(name)
    off = math.hypot(x, y)
    height = lift.over(off)
    return nearness(abs(z + height) + off + height)


def nearness(rest: float) -> float:
    """Return 1 if at most `AT_GOAL` is left; it falls towards 0 as more is left.

    Args:
        rest: The distance left [m].
    """
    return _HALFWAY / (_HALFWAY + max(0.0, rest - AT_GOAL))
