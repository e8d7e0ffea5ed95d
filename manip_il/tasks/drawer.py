"""Drawer: open it by its handle, put the object in, close it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.robots.rotations import angle_ahead, angle_from_down, hand_down
from manip_il.sim.task import Limits, Observed, Rung, Start, Target
from manip_il.sim.world import World
from manip_il.tasks.cabinet import (
    BAR,
    BAR_HALF,
    BAR_Z,
    CABINET,
    INSIDE,
    OPEN,
    WALL,
    add_cabinet,
    hand_at_handle,
    middle_of_drawer,
    pulled,
)
from manip_il.tasks.grasp import lie_of
from manip_il.tasks.ladder import Lift, carry, carry_progress, grasp_progress, grasp_rungs, held, let_go, nearness
from manip_il.tasks.objects import add_cube
from manip_il.tasks.pick_place import OBJECT, observe_object
from manip_il.tasks.reach import observe_hand
from manip_il.tasks.starts import UPRIGHT, draw_resting, draw_until, draw_yaw

F64 = NDArray[np.float64]

HALF = 0.02  # of the cube's edge [m]
OPEN_ENOUGH, SHUT = 0.09, 0.008  # how far the drawer is pulled for the object to go in, and is shut at most [m]
FINGERS = 0.045  # opening of the fingers around the handle [m]
SLACK = FINGERS / 2 - BAR_HALF  # of the hand along the pull before a finger meets the handle [m]
AROUND = (0.024, 0.03, 0.018, 0.25)  # of the hand off the handle while it moves it: x, y, z [m], angle [rad]
HOVER, SLOPE = 0.08, 2.0  # of the hand over the handle on its way there [m]; height gained per distance from it
BESIDE_X, BESIDE_Y = 0.01, INSIDE[1] + 0.08  # of the object from the closed drawer's handle at the start [m]
DROP = 0.018  # of the object over the drawer's floor where it is let go [m]
OVER = 0.13  # of the hand over the object on its way to it [m]
OVER_FRONT = Lift(most=0.085, slope=2.5, free=0.012, rise_first=0.03, max_step=0.06)  # on the way into the drawer
OVER_TABLE = Lift(most=0.04, slope=0.6, free=0.012, rise_first=0.03, max_step=0.06)  # on the way to beside it
MUCH_NEARER = 2.3  # how much nearer a hand must be to the other yaw at the handle to take that [rad]
LEFT = (0.03, 0.06, 0.03)  # of the hand off the handle where it need not rise from it any more: x, y, z [m]
# In the cabinet's frame: where an object is in the handle's way, x and y; where it lies before the handle of the shut
# drawer, x; and where it is put aside [m].
WAY_X, WAY_Y, BEFORE, ASIDE = (-0.20, 0.07), 0.12, -0.06, (-0.04, 0.17)
_STEP = 0.04  # how far ahead of the hand its target runs while it moves the drawer [m]


def is_inside(world: World) -> bool:
    """Return whether the object is in the drawer."""
    x, y, z = (world.pose(OBJECT).position - middle_of_drawer(world)).tolist()
    return abs(x) < INSIDE[0] and abs(y) < INSIDE[1] and z < WALL + 0.01


def _yaw(world: World) -> float:
    """Yaw of a hand whose fingers close along the drawer's way: the first of two, or one that is much nearer [rad].

    Two that were chosen by nearness alone would be as near from most starts, and a learner would stand between them.
    """
    at, quarter = angle_ahead(world.ee.rotation), math.pi / 2
    return quarter if abs(quarter - at) < abs(-quarter - at) + MUCH_NEARER else -quarter


def _at_bar(world: World) -> bool:
    x, y, z = (world.ee.position - hand_at_handle(world)).tolist()
    most_x, most_y, most_z, most_angle = AROUND
    return (
        abs(x) < most_x
        and abs(y) < most_y
        and abs(z) < most_z
        and angle_from_down(world.ee.rotation, _yaw(world)) < most_angle
        and world.opening < FINGERS + 0.012
    )


def _to_bar(world: World) -> Target:
    """Over the handle and down around it; straight up if too low beside it."""
    ee, bar, yaw = world.ee, hand_at_handle(world), _yaw(world)
    off = math.hypot(*(bar - ee.position)[:2]) + 0.05 * max(0.0, angle_from_down(ee.rotation, yaw) - 0.1)
    height = min(HOVER, SLOPE * max(0.0, off - 0.006))
    if abs(world.opening - FINGERS) > 0.012:
        height = max(height, 0.05)
    sideways = min(1.0, max(0.0, 1.0 - (bar[2] + height - ee.position[2]) / 0.03))
    position = np.append(ee.position[:2] + sideways * (bar - ee.position)[:2], bar[2] + height)
    return Target(position, hand_down(yaw), FINGERS)


def _move_drawer(world: World, to: float) -> Target:
    """Move the drawer by its handle until it is open so far [m]."""
    way = pulled(world) - to
    step = way + math.copysign(SLACK, way)
    return Target(hand_at_handle(world) + [step, 0.0, 0.0], hand_down(_yaw(world)), FINGERS, max_step=_STEP)


def _is_shut(world: World) -> bool:
    return pulled(world) < SHUT


def _is_open(world: World) -> bool:
    return pulled(world) > (OPEN - 0.01 if _at_bar(world) else OPEN_ENOUGH)


def _hand_is_in(world: World) -> bool:
    """Whether the hand is at the object."""
    x, y, z = (world.ee.position - world.pose(OBJECT).position).tolist()
    return math.hypot(x, y) < 0.05 and z < 0.07


def _let_go(world: World) -> Target:
    return let_go(world, OBJECT, HOVER)


def _carry(world: World) -> Target:
    """Lift the object, move it over the drawer and lower it."""
    return carry(world, OBJECT, _place(world), OVER_FRONT)


def _place(world: World) -> F64:
    """Place in the drawer where the object's centre is let go, (3,) [m]."""
    return middle_of_drawer(world) + [0.0, 0.0, lie_of(world, OBJECT).tall / 2 + DROP]


def _leave(world: World) -> Target:
    """Straight up from the handle; the fingers open as they rise over it."""
    ee = world.ee.position
    over = min(1.0, max(0.0, (ee[2] - BAR_Z) / LEFT[2]))
    opening = FINGERS + over * (world.gripper.most - FINGERS)
    return Target(np.array([ee[0], ee[1], BAR_Z + HOVER]), hand_down(_yaw(world)), opening)


def _is_around_bar(world: World) -> bool:
    x, y, z = (world.ee.position - hand_at_handle(world)).tolist()
    return abs(x) < LEFT[0] and abs(y) < LEFT[1] and z < LEFT[2]


def _from_cabinet(world: World) -> tuple[float, float]:
    """The object in the cabinet's frame, x and y [m]."""
    x, y = (world.pose(OBJECT).position - world.pose(CABINET).position)[:2].tolist()
    return x, y


def _is_in_way(world: World) -> bool:
    """Whether the object lies where the handle passes over it, so that the hand cannot grasp it there."""
    x, y = _from_cabinet(world)
    return WAY_X[0] < x < WAY_X[1] and abs(y) < WAY_Y


def _must_shut(world: World) -> bool:
    """Whether the object lies in the way of a drawer that is out, and before the handle of one that is shut."""
    return _is_in_way(world) and _from_cabinet(world)[0] < BEFORE and not _is_shut(world)


def _must_open(world: World) -> bool:
    """Whether the drawer is to be opened: always, unless the object lies before it and must be moved first."""
    return not _is_open(world) and not (_is_in_way(world) and _from_cabinet(world)[0] < BEFORE)


def _is_set_down(world: World) -> bool:
    low = world.pose(OBJECT).position[2] - lie_of(world, OBJECT).tall / 2
    return low < 0.008 and not _is_in_way(world)


def _put_aside(world: World) -> Target:
    """Carry the object to the table beside the drawer, on the side where there is more of it."""
    cabinet = world.pose(CABINET).position
    side = math.copysign(ASIDE[1], world.scene.robot.workspace.centre[1] - cabinet[1])
    to = np.array([cabinet[0] + ASIDE[0], cabinet[1] + side, lie_of(world, OBJECT).tall / 2])
    return carry(world, OBJECT, to, OVER_TABLE)


_RUNGS = (
    Rung("done", "the object is in the drawer, and it is shut", lambda w: is_inside(w) and _is_shut(w), _to_bar),
    Rung(
        "let_go",
        "the object is in the drawer, and the hand lets go of it",
        lambda w: is_inside(w) and _hand_is_in(w),
        _let_go,
    ),
    Rung(
        "push",
        "the object is in the drawer, and the hand pushes it shut",
        lambda w: is_inside(w) and _at_bar(w),
        lambda w: _move_drawer(w, -0.01),
    ),
    Rung("to_push", "the object is in the drawer, and the hand goes to the handle", is_inside, _to_bar),
    Rung(
        "carry",
        "the object is in the hand, on its way to the open drawer",
        lambda w: held(w, OBJECT) and _is_open(w),
        _carry,
    ),
    Rung(
        "set_down",
        "the object is in the hand on the table, and the drawer is not open",
        lambda w: held(w, OBJECT) and _is_set_down(w),
        _let_go,
    ),
    Rung(
        "put_aside",
        "the object is in the hand, on its way to beside the drawer, which is not open",
        lambda w: held(w, OBJECT),
        _put_aside,
    ),
    Rung(
        "make_way",
        "the object lies in the way of the open drawer, and the hand pushes it shut",
        lambda w: _must_shut(w) and _at_bar(w),
        lambda w: _move_drawer(w, -0.01),
    ),
    Rung(
        "to_make_way",
        "the object lies in the way of the open drawer, and the hand goes to the handle",
        _must_shut,
        _to_bar,
    ),
    Rung(
        "pull",
        "the hand is at the handle and pulls the drawer open",
        lambda w: _must_open(w) and _at_bar(w),
        lambda w: _move_drawer(w, OPEN),
    ),
    Rung("to_pull", "the drawer is not open, and the hand goes to the handle", _must_open, _to_bar),
    Rung("leave", "the drawer is as it should be, and the hand rises from its handle", _is_around_bar, _leave),
    *grasp_rungs(lambda w: OBJECT, OVER),
)


@dataclass(frozen=True)
class Drawer:
    """Open a drawer, put a cube in it, close it."""

    name: str = "drawer"
    instruction: str = "Put the red cube in the drawer and close it."
    limits: Limits = Limits(tolerance=SHUT, horizon=500)
    objects: tuple[str, ...] = (OBJECT,)
    grasped: tuple[str, ...] = (OBJECT,)
    sizes: tuple[float, float] | None = (0.03, 0.045)
    rungs: tuple[Rung, ...] = _RUNGS

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the cube, and a cabinet with a drawer."""
        add_cube(spec, OBJECT, HALF)
        add_cabinet(spec)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw where the cabinet stands, left or right, and the cube beside its drawer, at any yaw."""
        x, y = world.scene.robot.workspace.centre
        side = rng.choice([-1.0, 1.0])
        cabinet = np.array([x + rng.uniform(0.03, 0.07), y + side * rng.uniform(0.05, 0.10), 0.0])

        def fits(at: F64) -> bool:
            return at[0] < cabinet[0] + BESIDE_X and abs(at[1] - cabinet[1]) > BESIDE_Y

        at = draw_until(lambda: draw_resting(rng, world, OBJECT), fits, world, OBJECT)
        return Start({OBJECT: (at, draw_yaw(rng)), CABINET: (cabinet, UPRIGHT)})

    def observe(self, world: World) -> Observed:
        """Return hand, cube and handle, how far the drawer is open, and the ways between them."""
        ee, bar, cube = world.ee.position, hand_at_handle(world), world.pose(OBJECT).position
        return {
            **observe_hand(world),
            **observe_object(world, OBJECT),
            BAR: bar,
            "drawer.open": pulled(world),
            "handle_from_ee": bar - ee,
            "drawer_from_object": middle_of_drawer(world) - cube,
        }

    def destination(self, world: World) -> F64:
        """Return the middle of the drawer, (3,) [m]."""
        return middle_of_drawer(world)

    def error(self, world: World) -> float:
        """Return how far the drawer is open [m], and as much more as the object is from its inside."""
        missing = 0.0 if is_inside(world) else math.dist(world.pose(OBJECT).position, middle_of_drawer(world))
        return max(0.0, pulled(world)) + missing

    def progress(self, world: World) -> float:
        """Return progress of opening, putting in and closing."""
        opened = min(1.0, max(0.0, pulled(world) / OPEN))
        if is_inside(world):
            if _is_shut(world):
                return 1.0
            if _hand_is_in(world):
                return 0.75
            return 0.8 + 0.05 * nearness(math.dist(world.ee.position, hand_at_handle(world))) + 0.15 * (1 - opened)
        if held(world, OBJECT) and _is_open(world):
            return 0.5 + 0.25 * carry_progress(world, OBJECT, _place(world), OVER_FRONT)
        if _is_open(world):
            return 0.3 + 0.15 * grasp_progress(world, OBJECT)
        return 0.1 * nearness(math.dist(world.ee.position, hand_at_handle(world))) + 0.2 * opened
