"""Open boxes, and the ladder that drops objects into them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import World
from manip_il.tasks.grasp import grasp_of, hand_down, lie_of
from manip_il.tasks.ladder import CLOSED, Place, Which, held, nearness
from manip_il.tasks.objects import WOOD, add_furniture, add_part
from manip_il.tasks.task import Rung, Target

F64 = NDArray[np.float64]

WALL, THIN = 0.05, 0.003  # of a box: its height, half the thickness of walls and floor [m]
DROP = 0.02  # of an object's bottom over a box's floor where it is let go [m]
LIFT, LIFT_SLOPE, FREE = 0.10, 2.5, 0.012  # of a carried object over that; per distance; distance without [m]
OVER = 0.11  # of the hand over an object on its way to it [m]
RELEASE = 0.03  # how far the fingers open about an object to let it go, beyond its width [m]
_LET_GO = 0.012  # opening beyond an object's width at which it is free [m]
_AT = (0.05, 0.07)  # of the hand from an object in a box that it is still at: sideways, above [m]
_STEP = 0.06  # how far ahead of the hand its target runs while it carries [m]


def add_bin(
    spec: mujoco.MjSpec, name: str, inside: tuple[float, float], colour: tuple[float, ...] = WOOD
) -> None:
    """Add an open box, placed by a start: half its inner length and width [m]."""
    box = add_furniture(spec, name)
    length, width = inside
    add_part(box, f"{name} floor", (length, width, THIN), (0, 0, THIN), colour)
    for side, sign in (("left", 1), ("right", -1)):
        add_part(box, f"{name} {side}", (length + 2 * THIN, THIN, WALL / 2), (0, sign * (width + THIN), WALL / 2), colour)
    for side, sign in (("far", 1), ("near", -1)):
        add_part(box, f"{name} {side}", (THIN, width, WALL / 2), (sign * (length + THIN), 0, WALL / 2), colour)


def is_in(world: World, name: str, box: str, inside: tuple[float, float]) -> bool:
    """Return whether an object's centre is between a box's walls."""
    x, y, z = (world.pose(name).position - world.pose(box).position).tolist()
    return abs(x) < inside[0] and abs(y) < inside[1] and z < WALL + 0.01


def drop_rungs(which: Which, to: Place, is_done: Callable[[World, str], bool], names: Sequence[str]) -> tuple[Rung, ...]:
    """Return the rungs that bring the held object over its place in a box and let it go there.

    which: the object that is held or next; to: where its centre is let go. is_done: whether an object is where it
    belongs.
    """

    def at_done(world: World) -> bool:
        return any(is_done(world, name) and _hand_is_at(world, name) for name in names)

    return (
        Rung("let_go", "an object is in its box, and the hand lets go of it", at_done, lambda w: _let_go(w, names)),
        Rung("carry", "the object is in the hand, on its way to its box",
             lambda w: held(w, which(w)), lambda w: _carry(w, which(w), to(w))),
    )  # fmt: skip


def drop_progress(world: World, name: str, to: F64) -> float:
    """Return progress of carrying a held object to where it is let go, 0 to 1."""
    way = to - world.pose(name).position
    off = math.hypot(way[0], way[1])
    return nearness(off + abs(way[2] + _lift(off)))


def _hand_is_at(world: World, name: str) -> bool:
    x, y, z = (world.ee.position - world.pose(name).position).tolist()
    return math.hypot(x, y) < _AT[0] and z < _AT[1]


def _let_go(world: World, names: Sequence[str]) -> Target:
    """Open the fingers about the object, then rise."""
    ee = world.ee
    name = min(names, key=lambda one: math.dist(world.pose(one).position, ee.position))
    g = grasp_of(world, name)
    free = world.opening > g.width + _LET_GO and not world.touched(name)
    yaw = math.atan2(ee.rotation[1, 0], ee.rotation[0, 0])
    up = ee.position[2] + (0.1 if free else 0.0)
    return Target(np.array([*ee.position[:2], up]), hand_down(yaw), min(g.width + RELEASE, world.most_opening))


def _lift(off: float) -> float:
    return min(LIFT, LIFT_SLOPE * max(0.0, off - FREE))


def _carry(world: World, name: str, to: F64) -> Target:
    way = to - world.pose(name).position
    off = math.hypot(way[0], way[1])
    missing = way[2] + _lift(off)
    sideways = min(1.0, max(0.0, 1.0 - missing / 0.03)) if off > FREE else 1.0
    step = np.array([sideways * way[0], sideways * way[1], missing])
    return Target(world.ee.position + step, hand_down(0.0), CLOSED, max_step=_STEP)


def drop_place(world: World, name: str, box: str, offset: Sequence[float] = (0.0, 0.0)) -> F64:
    """Return where an object's centre is let go over a box's floor, `offset` (2,) from its middle; (3,) [m]."""
    height = 2 * THIN + lie_of(world, name).tall / 2 + DROP
    return world.pose(box).position + [offset[0], offset[1], height]
