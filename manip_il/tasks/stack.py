"""Stack: one cube on another, standing there by itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import World
from manip_il.tasks.grasp import grasp_of, hand_down, lie_of
from manip_il.tasks.ladder import CLOSED, grasp_progress, grasp_rungs, held, nearness
from manip_il.tasks.objects import BLUE, RED, add_cube
from manip_il.tasks.pick_place import observe_object
from manip_il.tasks.reach import observe_hand
from manip_il.tasks.starts import draw_resting, draw_until, draw_yaw
from manip_il.tasks.task import Limits, Observed, Rung, Start, Target

F64 = NDArray[np.float64]

TOP, BASE = "top", "base"  # the cube that is carried, and the one that it is put on
ON_XY, ON_Z, LEVEL = 0.015, 0.004, 0.1  # off the place on the base: sideways, in height [m]; tilt [rad]
LIFT, LIFT_SLOPE = 0.06, 2.5  # of the carried cube over its place; per horizontal distance still to go [m]
CLEAR = 0.005  # of the carried cube over its place while it is not above it [m]
FREE = 0.008  # horizontal distance at which it may be all the way down [m]
AWAY = 0.06  # of the hand over the stack's top once it has let go [m]
APART = 0.09  # of the cubes at the start [m]
_HAND = 0.05  # what a hand that is still at the cube counts for as an error [m]
_STEP = 0.05  # how far ahead of the hand its target runs while it carries [m]


def place_on_base(world: World) -> F64:
    """Return where the centre of the upper cube is to be, (3,) [m]."""
    height = (lie_of(world, BASE).tall + lie_of(world, TOP).tall) / 2
    return world.pose(BASE).position + [0.0, 0.0, height]


def stands(world: World) -> bool:
    """Return whether the upper cube lies level on the base."""
    x, y, z = (world.pose(TOP).position - place_on_base(world)).tolist()
    return math.hypot(x, y) < ON_XY and abs(z) < ON_Z and max(lie_of(world, TOP).tilt, lie_of(world, BASE).tilt) < LEVEL


def _hand_is_away(world: World) -> bool:
    g = grasp_of(world, TOP)
    return bool(world.ee.position[2] > world.pose(TOP).position[2] + g.half + 0.6 * AWAY)


def _let_go(world: World) -> Target:
    """Open the fingers, then rise straight up."""
    g, ee = grasp_of(world, TOP), world.ee
    up = world.pose(TOP).position[2] + g.half + AWAY if g.open_enough or world.opening > 0.9 * world.most_opening else ee.position[2]
    yaw = math.atan2(ee.rotation[1, 0], ee.rotation[0, 0])
    return Target(np.array([*ee.position[:2], up]), hand_down(yaw), world.most_opening)


def _carry(world: World) -> Target:
    """Lift the cube, move it over its place and set it down."""
    at, place = world.pose(TOP).position, place_on_base(world)
    way = place - at
    off = math.hypot(way[0], way[1])
    lift = min(LIFT, LIFT_SLOPE * max(0.0, off - FREE))
    missing = way[2] + lift  # height that it must gain
    sideways = min(1.0, max(0.0, 1.0 - missing / 0.03)) if off > FREE else 1.0
    step = np.array([sideways * way[0], sideways * way[1], missing])
    return Target(world.ee.position + step, hand_down(0.0), CLOSED, max_step=_STEP)


_RUNGS = (
    Rung("done", "the cube stands on the other, and the hand is away", lambda w: stands(w) and _hand_is_away(w), _let_go),
    Rung("let_go", "the cube stands on the other, and the hand lets go of it", stands, _let_go),
    Rung("carry", "the cube is in the hand, on its way to the other", lambda w: held(w, TOP), _carry),
    *grasp_rungs(lambda w: TOP),
)


@dataclass(frozen=True)
class Stack:
    """Put the red cube on the blue one and let go: it must stand by itself for a second."""

    name: str = "stack"
    instruction: str = "Stack the red cube on the blue cube."
    limits: Limits = Limits(success_steps=20, horizon=200)
    objects: tuple[str, ...] = (TOP, BASE)
    grasped: tuple[str, ...] = (TOP,)
    sizes: tuple[float, float] | None = (0.03, 0.07)
    rungs: tuple[Rung, ...] = _RUNGS

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the cubes."""
        add_cube(spec, TOP, colour=RED)
        add_cube(spec, BASE, colour=BLUE)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw both cubes on the table, apart, at any yaw."""
        base = draw_resting(rng, world, BASE)
        top = draw_until(lambda: draw_resting(rng, world, TOP), lambda at: math.dist(at, base) > APART, world, TOP)
        return Start({TOP: (top, draw_yaw(rng)), BASE: (base, draw_yaw(rng))})

    def observe(self, world: World) -> Observed:
        """Return hand and cubes, and the ways between them."""
        return {
            **observe_hand(world),
            **observe_object(world, TOP),
            **observe_object(world, BASE),
            "place_from_top": place_on_base(world) - world.pose(TOP).position,
        }

    def error(self, world: World) -> float:
        """Return how far the cube is from its place on the other [m]; more while the hand is at it."""
        off = math.dist(world.pose(TOP).position, place_on_base(world))
        return off + (0.0 if stands(world) and _hand_is_away(world) else _HAND)

    def progress(self, world: World) -> float:
        """Return progress of grasping, carrying and letting go."""
        if stands(world):
            if _hand_is_away(world):
                return 1.0
            return 0.9 + 0.1 * min(1.0, world.opening / world.most_opening)
        if held(world, TOP):
            way = place_on_base(world) - world.pose(TOP).position
            off = math.hypot(way[0], way[1])
            return 0.5 + 0.4 * nearness(off + abs(way[2] + min(LIFT, LIFT_SLOPE * max(0.0, off - FREE))))
        return 0.45 * grasp_progress(world, TOP)
