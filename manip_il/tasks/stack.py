"""Stack: put one cube on another, where it stands by itself."""

import math
from types import MappingProxyType

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.sim.task import Observed, Rung, Start, Target, Task
from manip_il.sim.world import World
from manip_il.tasks.grasp import grasp_of, lie_of
from manip_il.tasks.ladder import (
    LiftProfile,
    carry,
    carry_progress,
    grasp_progress,
    grasp_rungs,
    is_held,
    let_go,
)
from manip_il.tasks.objects import (
    BLUE,
    RED,
    add_cube,
    draw_resting,
    draw_until,
    draw_yaw,
    observe_hand,
    observe_object,
)

TOP, BASE = "top", "base"  # the cube that is carried, and the one that it is put on
# tolerances on the base: sideways, in height [m]; tilt [rad]
ON_XY = 0.015
ON_Z = 0.004
LEVEL = 0.1
LEANS_Z, LEANS = 0.008, 0.3  # the same for a cube in a leaning hand: in height [m]; tilt [rad]
# carried cube over its place
OVER_BASE = LiftProfile(most=0.06, slope=2.5, free=0.008, rise_first=0.03, max_step=0.05)
PRESS = 0.01  # how far below the base's top the cube is aimed, so that it makes contact [m]
# heights of the hand over the stack: target after release; least to count as away [m]
AWAY, AWAY_ENOUGH = 0.06, 0.035
APART = 0.09  # least distance between cubes at the start [m]
ROOM = 0.05  # reachable margin around each cube at the start [m]
_HAND = 0.05  # error added while the hand is at the cube [m]


def place_on_base(world: World) -> F64:
    """Return the target of the upper cube's centre, (3,) [m]."""
    height = (lie_of(world, BASE).tall + lie_of(world, TOP).tall) / 2
    return world.at(BASE) + [0.0, 0.0, height]


def stands(world: World) -> bool:
    """Return whether the upper cube lies level on the base."""
    return (
        _is_on_base(world, ON_Z) and max(lie_of(world, TOP).tilt, lie_of(world, BASE).tilt) < LEVEL
    )


def _rests(world: World) -> bool:
    """Whether a leaning hand has put the upper cube on the base, where it will lie level once
    released.
    """
    return world.robot.leans and _is_on_base(world, LEANS_Z) and lie_of(world, TOP).tilt < LEANS


def _is_on_base(world: World, height: float) -> bool:
    x, y, z = world.at(TOP) - place_on_base(world)
    return math.hypot(x, y) < ON_XY and abs(z) < height


def _hand_is_away(world: World) -> bool:
    return world.ee.position[2] > world.at(TOP)[2] + grasp_of(world, TOP).half + AWAY_ENOUGH


def _let_go(world: World) -> Target:
    return let_go(world, TOP, grasp_of(world, TOP).half + AWAY)


class Stack(Task):
    """Put the red cube on the blue one and let go: it must stand by itself for a second."""

    name = "stack"
    instruction = "Stack the red cube on the blue cube."
    nouns = MappingProxyType({TOP: "red cube", BASE: "blue cube"})
    place = "the blue cube"
    success_steps = 20
    horizon = 400
    objects = (TOP, BASE)
    grasped = (TOP,)
    sizes = (0.03, 0.07)
    rungs = (
        Rung("done", lambda w: stands(w) and _hand_is_away(w), _let_go),
        Rung("let_go", lambda w: stands(w) or _rests(w), _let_go),
        Rung(
            "carry",
            lambda w: is_held(w, TOP),
            lambda w: carry(w, TOP, place_on_base(w) - [0.0, 0.0, PRESS], OVER_BASE),
        ),
        *grasp_rungs(lambda w: TOP),
    )

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the cubes."""
        add_cube(spec, TOP, colour=RED)
        add_cube(spec, BASE, colour=BLUE)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw both cubes on the table, apart, at any yaw."""
        height = (world.extents(BASE)[2] + world.extents(TOP)[2]) / 2
        base = draw_until(
            lambda: draw_resting(rng, world, BASE, ROOM),
            lambda at: world.reach.has(at + [0, 0, height]),
            world,
            BASE,
        )
        top = draw_until(
            lambda: draw_resting(rng, world, TOP, ROOM),
            lambda at: math.dist(at, base) > APART,
            world,
            TOP,
        )
        return Start({TOP: (top, draw_yaw(rng)), BASE: (base, draw_yaw(rng))})

    def observe(self, world: World) -> Observed:
        """Return hand and cubes, and the vectors between them."""
        return {
            **observe_hand(world),
            **observe_object(world, TOP),
            **observe_object(world, BASE),
            "place_from_top": place_on_base(world) - world.at(TOP),
        }

    def error(self, world: World) -> float:
        """Return the cube's distance from its place on the base [m].

        0.05 m are added until it stands without the hand.
        """
        off = math.dist(world.at(TOP), place_on_base(world))
        return off + (0.0 if stands(world) and _hand_is_away(world) else _HAND)

    def progress(self, world: World) -> float:
        """Return progress of grasping, carrying and letting go."""
        if stands(world):
            opened = min(1.0, world.opening / world.gripper.most)
            return 1.0 if _hand_is_away(world) else 0.9 + 0.1 * opened
        if is_held(world, TOP):
            return 0.5 + 0.4 * carry_progress(world, TOP, place_on_base(world), OVER_BASE)
        return 0.45 * grasp_progress(world, TOP)
