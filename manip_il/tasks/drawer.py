"""Drawer: open it by its handle, put the object in, close it."""

import math
from collections.abc import Callable
from types import MappingProxyType

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import angle_ahead, angle_from_down, hand_down
from manip_il.sim.task import Observed, Rung, Start, Target, Task
from manip_il.sim.world import World
from manip_il.tasks.grasp import is_inside, lie_of, share
from manip_il.tasks.ladder import (
    LiftProfile,
    carry,
    carry_progress,
    grasp_progress,
    grasp_rungs,
    hand_is_at,
    is_held,
    let_go,
    nearness,
    rise_first,
)
from manip_il.tasks.objects import (
    GREY,
    UPRIGHT,
    add_cube,
    add_furniture,
    add_part,
    add_sides,
    draw_resting,
    draw_until,
    draw_yaw,
    observe_hand,
    observe_object,
)
from manip_il.tasks.pick_place import OBJECT

CABINET = "cabinet"
TRAY = "drawer"
BAR = "handle"
# The cabinet's frame lies on the table under the handle of the closed drawer, x into the cabinet.
GAP = 0.056  # distance of the handle's middle from the drawer's front [m]
INSIDE = (0.05, 0.06)  # half the drawer's inner length and width [m]
# drawer: heights of walls, floor, front; half wall thickness [m]
WALL = 0.035
FLOOR = 0.010
PANEL = 0.090
THIN = 0.004
ROOF = 0.080  # inner height of the cabinet over the table [m]
MIDDLE = GAP + 2 * THIN + INSIDE[0]  # distance of the drawer's inner middle from its handle [m]
# handle: height, half its thickness, half its length [m]
BAR_Z = 0.080
BAR_HALF = 0.006
BAR_LENGTH = 0.05
OPEN = 0.12  # how far the drawer is pulled [m]
HAND_Z = BAR_Z - 0.005  # height of the hand at the handle [m]
HALF = 0.02  # half the cube's edge length [m]
OPEN_ENOUGH, SHUT = 0.09, 0.008  # opening that lets the object in; largest that counts as shut [m]
FINGERS = 0.045  # opening of the fingers around the handle [m]
# play of the hand along the pull before a finger meets the handle [m]
SLACK = FINGERS / 2 - BAR_HALF
AROUND = (0.024, 0.03, 0.018)  # largest offset of the moving hand from the handle [m]
AROUND_ANGLE = 0.25  # [rad]
SPARE = 0.012  # deviation from `FINGERS` up to which the fingers fit around the handle [m]
HOVER = 0.08  # greatest height of the hand over the handle on its way there [m]
FUNNEL = LiftProfile(HOVER, slope=2.0, free=0.006)  # that height, by the hand's misalignment
# object's offset from the handle at the start: most in x, least in y [m]
BESIDE_X, BESIDE_Y = 0.01, INSIDE[1] + 0.08
DROP = 0.018  # height of the object over the drawer's floor at release [m]
OVER = 0.13  # height of the hand over the object on approach [m]
# into the drawer
OVER_FRONT = LiftProfile(most=0.085, slope=2.5, free=0.012, rise_first=0.03, max_step=0.06)
# to a place beside it
OVER_TABLE = LiftProfile(most=0.04, slope=0.6, free=0.012, rise_first=0.03, max_step=0.06)
MUCH_NEARER = 2.3  # how much nearer the yaw -pi/2 at the handle must be to be chosen [rad]
# offset from the handle beyond which the hand need not rise first: x, y, z [m]
LEFT = (0.03, 0.06, 0.03)
# In the cabinet's frame [m]: where an object is in the handle's way, x and y; x below which it lies
# in front of the closed handle; and where it is put aside.
WAY_X = (-0.20, 0.07)
WAY_Y = 0.12
BEFORE = -0.06
ASIDE = (-0.04, 0.17)
_STEP = 0.04  # how far ahead of the hand its target runs while it moves the drawer [m]


def add_cabinet(spec: mujoco.MjSpec) -> None:
    """Add a cabinet with a drawer that slides out towards the robot."""
    cabinet = add_furniture(spec, CABINET)
    front = GAP + 2 * THIN  # where the drawer's inside begins
    length, width = INSIDE
    deep, wide = length + 2 * THIN, width + 3 * THIN  # half the cabinet's depth and width
    back = front + 2 * deep
    whole = wide + 2 * THIN
    add_sides(cabinet, "cabinet", (deep, THIN, ROOF / 2), (front + deep, wide + THIN, ROOF / 2))
    add_part(cabinet, "cabinet back", (THIN, whole, ROOF / 2), (back + THIN, 0, ROOF / 2))
    top = (front + deep + THIN, 0, ROOF + THIN)
    add_part(cabinet, "cabinet top", (deep + THIN, whole, THIN), top)
    tray = cabinet.add_body(name=TRAY)
    tray.add_joint(
        name=TRAY, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[-1, 0, 0], limited=True, range=[0, OPEN],
        damping=[5.0, 0, 0], frictionloss=0.5, armature=0.05,
    )  # fmt: skip
    middle = front + length
    add_part(tray, "drawer floor", (length, width, THIN), (middle, 0, FLOOR - THIN))
    add_sides(tray, "drawer", (length, THIN, WALL / 2), (middle, width + THIN, WALL / 2))
    # so high that nothing gets behind it
    back_z, back_half = (ROOF - THIN + FLOOR) / 2, (ROOF - THIN - FLOOR) / 2
    back = (front + 2 * length + THIN, 0, back_z)
    add_part(tray, "drawer back", (THIN, width, back_half), back)
    add_part(tray, "drawer front", (THIN, whole, PANEL / 2), (GAP + THIN, 0, PANEL / 2))
    add_part(tray, BAR, (BAR_HALF, BAR_LENGTH, BAR_HALF), (0, 0, BAR_Z), GREY)
    add_sides(tray, BAR, (GAP / 2, BAR_HALF, BAR_HALF), (GAP / 2, BAR_LENGTH, BAR_Z), GREY)
    spec.add_exclude(bodyname1=CABINET, bodyname2=TRAY)


def pulled(world: World) -> float:
    """Return how far the drawer is open [m]."""
    return world.at(CABINET)[0] - world.at(TRAY)[0]


def middle_of_drawer(world: World) -> F64:
    """Return the middle of the drawer's floor, (3,) [m]."""
    return world.at(TRAY) + [MIDDLE, 0.0, FLOOR]


def hand_at_handle(world: World) -> F64:
    """Return the hand's position with the handle between its fingers, (3,) [m]."""
    return world.at(TRAY) + [0.0, 0.0, HAND_Z]


def is_in_drawer(world: World) -> bool:
    """Return whether the object is in the drawer."""
    x, y, z = world.at(OBJECT) - middle_of_drawer(world)
    return abs(x) < INSIDE[0] and abs(y) < INSIDE[1] and z < WALL + 0.01


def _yaw(world: World) -> float:
    """Yaw at which the fingers close along the drawer's motion [rad]: pi/2, or -pi/2 if that is
    much nearer.

    From most starts both are about equally near; if the nearer were taken, a learner would stop
    between them.
    """
    at, quarter = angle_ahead(world.ee.rotation), math.pi / 2
    return quarter if abs(quarter - at) < abs(-quarter - at) + MUCH_NEARER else -quarter


def _at_bar(world: World) -> bool:
    is_near = is_inside(world.ee.position - hand_at_handle(world), AROUND)
    angle = angle_from_down(world.ee.rotation, _yaw(world))
    return is_near and angle < AROUND_ANGLE and world.opening < FINGERS + SPARE


def _to_bar(world: World) -> Target:
    """Move over the handle and down around it; a hand too low beside it only rises."""
    ee = world.ee
    bar = hand_at_handle(world)
    yaw = _yaw(world)
    off = math.hypot(*(bar - ee.position)[:2]) + 0.05 * max(
        0.0, angle_from_down(ee.rotation, yaw) - 0.1
    )
    height = FUNNEL.over(off)
    if abs(world.opening - FINGERS) > SPARE:
        height = max(height, 0.05)
    return Target(rise_first(ee.position, bar + [0.0, 0.0, height]), hand_down(yaw), FINGERS)


def _move_drawer(world: World, to: float) -> Target:
    """Move the drawer by its handle until it is open by `to` [m]."""
    way = pulled(world) - to
    step = way + math.copysign(SLACK, way)
    return Target(
        hand_at_handle(world) + [step, 0.0, 0.0], hand_down(_yaw(world)), FINGERS, max_step=_STEP
    )


def _let_go(world: World) -> Target:
    return let_go(world, OBJECT, HOVER)


def _is_open(world: World) -> bool:
    return pulled(world) > (OPEN - 0.01 if _at_bar(world) else OPEN_ENOUGH)


def _hand_is_in(world: World) -> bool:
    return hand_is_at(world, OBJECT, 0.05, 0.07)


def _place(world: World) -> F64:
    """Release point of the object's centre in the drawer, (3,) [m]."""
    return middle_of_drawer(world) + [0.0, 0.0, lie_of(world, OBJECT).tall / 2 + DROP]


def _leave(world: World) -> Target:
    """Rise straight up from the handle, opening the fingers above it."""
    x, y, z = world.ee.position
    opening = FINGERS + share((z - BAR_Z) / LEFT[2]) * (world.gripper.most - FINGERS)
    return Target(np.array([x, y, BAR_Z + HOVER]), hand_down(_yaw(world)), opening)


def _is_around_bar(world: World) -> bool:
    x, y, z = world.ee.position - hand_at_handle(world)
    return abs(x) < LEFT[0] and abs(y) < LEFT[1] and z < LEFT[2]


def _is_in_way(world: World, farthest: float = WAY_X[1]) -> bool:
    """Whether the object lies where the handle passes over it, so that the hand cannot grasp it
    there.

    farthest: upper bound along the cabinet's x [m].
    """
    x, y, _ = world.at(OBJECT) - world.at(CABINET)
    return WAY_X[0] < x < farthest and abs(y) < WAY_Y


def _must_shut(world: World) -> bool:
    """Whether to shut the drawer first: the object lies in its way, in front of the closed
    handle.
    """
    return _is_in_way(world, BEFORE) and pulled(world) >= SHUT


def _must_open(world: World) -> bool:
    """Whether to open the drawer: it is not open, and the object does not lie in front of the
    closed handle.
    """
    return not _is_open(world) and not _is_in_way(world, BEFORE)


def _is_set_down(world: World) -> bool:
    low = world.at(OBJECT)[2] - lie_of(world, OBJECT).tall / 2
    return low < 0.008 and not _is_in_way(world)


def _put_aside(world: World) -> Target:
    """Carry the object to the table beside the drawer, on the side with more table."""
    cabinet = world.at(CABINET)
    side = math.copysign(ASIDE[1], world.robot.workspace.centre[1] - cabinet[1])
    to = cabinet + [ASIDE[0], side, lie_of(world, OBJECT).tall / 2]
    return carry(world, OBJECT, to, OVER_TABLE)


def _move_rungs(name: str, holds: Callable[[World], bool], to: float) -> tuple[Rung, ...]:
    """Rungs that go to the handle and move the drawer until it is open by `to` [m]."""
    return (
        Rung(name, lambda w: holds(w) and _at_bar(w), lambda w: _move_drawer(w, to)),
        Rung(f"to_{name}", holds, _to_bar),
    )


_TO_HANDLE = "reach for the handle"


class Drawer(Task):
    """Open a drawer, put a cube in it, close it."""

    name = "drawer"
    instruction = "Put the red cube in the drawer and close it."
    nouns = MappingProxyType({OBJECT: "red cube"})
    place = "the drawer"
    subtasks = MappingProxyType(
        {
            "to_pull": _TO_HANDLE,
            "pull": "pull the drawer open",
            "to_make_way": _TO_HANDLE,
            "make_way": "push the drawer out of the way",
            "to_push": _TO_HANDLE,
            "push": "push the drawer shut",
            "leave": "move away from the handle",
        }
    )
    tolerance = SHUT
    horizon = 500
    objects = (OBJECT,)
    grasped = (OBJECT,)
    sizes = (0.03, 0.045)
    rungs = (
        Rung("done", lambda w: is_in_drawer(w) and pulled(w) < SHUT, _to_bar),
        Rung("let_go", lambda w: is_in_drawer(w) and _hand_is_in(w), _let_go),
        *_move_rungs("push", is_in_drawer, -0.01),
        Rung(
            "carry",
            lambda w: is_held(w, OBJECT) and _is_open(w),
            lambda w: carry(w, OBJECT, _place(w), OVER_FRONT),
        ),
        Rung("set_down", lambda w: is_held(w, OBJECT) and _is_set_down(w), _let_go),
        Rung("put_aside", lambda w: is_held(w, OBJECT), _put_aside),
        *_move_rungs("make_way", _must_shut, -0.01),
        *_move_rungs("pull", _must_open, OPEN),
        Rung("leave", _is_around_bar, _leave),
        *grasp_rungs(lambda w: OBJECT, OVER),
    )

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the cube, and a cabinet with a drawer."""
        add_cube(spec, OBJECT, HALF)
        add_cabinet(spec)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw where the cabinet stands, left or right, and the cube beside its drawer.

        The cube has any yaw.
        """
        x, y = world.robot.workspace.centre
        side = rng.choice([-1.0, 1.0])
        cabinet = np.array([x + rng.uniform(0.03, 0.07), y + side * rng.uniform(0.05, 0.10), 0.0])

        def fits(at: F64) -> bool:
            return at[0] < cabinet[0] + BESIDE_X and abs(at[1] - cabinet[1]) > BESIDE_Y

        at = draw_until(lambda: draw_resting(rng, world, OBJECT), fits, world, OBJECT)
        return Start({OBJECT: (at, draw_yaw(rng)), CABINET: (cabinet, UPRIGHT)})

    def observe(self, world: World) -> Observed:
        """Return the hand, the cube, the handle, the vectors between them, and the opening [m]."""
        bar = hand_at_handle(world)
        return {
            **observe_hand(world),
            **observe_object(world, OBJECT),
            BAR: bar,
            "drawer.open": pulled(world),
            "handle_from_ee": bar - world.ee.position,
            "drawer_from_object": middle_of_drawer(world) - world.at(OBJECT),
        }

    def error(self, world: World) -> float:
        """Return how far the drawer is open, plus the object's distance from it [m].

        This is the distance from the drawer's middle, or 0 if the object is inside.
        """
        off = math.dist(world.at(OBJECT), middle_of_drawer(world))
        return max(0.0, pulled(world)) + (0.0 if is_in_drawer(world) else off)

    def progress(self, world: World) -> float:
        """Return progress of opening the drawer, putting the object in and closing it."""
        opened = share(pulled(world) / OPEN)
        at_handle = nearness(math.dist(world.ee.position, hand_at_handle(world)))
        if is_in_drawer(world):
            if pulled(world) < SHUT:
                return 1.0
            return 0.75 if _hand_is_in(world) else 0.8 + 0.05 * at_handle + 0.15 * (1 - opened)
        if is_held(world, OBJECT) and _is_open(world):
            return 0.5 + 0.25 * carry_progress(world, OBJECT, _place(world), OVER_FRONT)
        if _is_open(world):
            return 0.3 + 0.15 * grasp_progress(world, OBJECT)
        return 0.1 * at_handle + 0.2 * opened
