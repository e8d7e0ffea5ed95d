"""Press: push a button, which stands anywhere on the table, to its stop."""

import math
from types import MappingProxyType

import mujoco
import numpy as np

from manip_il.robots.geometry import hand_down
from manip_il.sim.task import Observed, Rung, Start, Target, Task
from manip_il.sim.world import World
from manip_il.tasks.ladder import CLOSED, LiftProfile, nearness, rise_first
from manip_il.tasks.objects import (
    GREY,
    RED,
    add_furniture,
    add_part,
    draw_resting,
    draw_yaw,
    observe_hand,
)

BUTTON, CAP = "button", "cap"
TRAVEL = 0.015  # travel of the cap [m]
CAP_RADIUS = 0.025  # [m]
TOP = 0.055  # height of the unpressed cap over the table [m]
STOPPED = 0.002  # distance of the cap from its stop at which it is pressed [m]
TIP = 0.02  # distance of the fingertips beyond `ee` [m]
OVER = 0.012  # largest offset of the pressing hand from the button's middle [m]
DEEPER = 0.012  # how far beyond the stop the hand aims, so that it presses [m]
# clearance over the cap before the hand is above it
FUNNEL = LiftProfile(0.08, slope=2.0, free=OVER)
_STIFF, _DAMPED = 150.0, 4.0  # stiffness and damping of the spring [N/m], [N s/m]


def pressed(world: World) -> float:
    """Return how far the cap is pressed down [m]."""
    return min(TRAVEL, max(0.0, TOP - world.at(CAP)[2]))


def _off(world: World) -> float:
    """Horizontal distance of the hand from the button [m]."""
    return math.hypot(*(world.ee.position - world.at(BUTTON))[:2])


def _aim(world: World) -> Target:
    """Go over the button, descending on the way; once above it, press beyond its stop."""
    off = _off(world)
    x, y, _ = world.at(BUTTON)
    height = FUNNEL.over(off) if off > OVER else -TRAVEL - DEEPER
    at = rise_first(world.ee.position, (x, y, height + (TOP + TIP)))
    return Target(at, hand_down(world.ahead(at)), CLOSED)


class Press(Task):
    """Press a button to its stop against its spring, and keep it there for a moment."""

    name = "press"
    instruction = "Press the red button."
    nouns = MappingProxyType({"cap": "red button"})
    subtasks = MappingProxyType({"pressed": "hold {it} down"})
    tolerance = STOPPED
    rungs = (
        Rung("pressed", lambda w: TRAVEL - pressed(w) < STOPPED, _aim),
        Rung("press", lambda w: _off(w) < OVER, _aim),
        Rung("approach", lambda w: True, _aim),
    )

    def moved(self, world: World, phase: str) -> str:
        """Return the name of what the hand reaches for: the button's cap."""
        return "cap"

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the button: a housing, and a cap on a spring."""
        button = add_furniture(spec, BUTTON)
        half = (TOP - TRAVEL - 0.005) / 2
        add_part(button, BUTTON, (0.04, 0.04, half), (0, 0, half), GREY)
        cap = button.add_body(name=CAP, pos=[0, 0, TOP])
        cap.add_joint(
            name=CAP, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, -1], limited=True,
            range=[0, TRAVEL], stiffness=[_STIFF, 0, 0], damping=[_DAMPED, 0, 0], armature=0.01,
        )  # fmt: skip
        cap.add_geom(
            name=CAP, type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[CAP_RADIUS, 0.01, 0],
            pos=[0, 0, -0.01], rgba=[*RED, 1], mass=0.05,
        )  # fmt: skip
        spec.add_exclude(bodyname1=BUTTON, bodyname2=CAP)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw where the button stands, not under the hand, and its yaw."""
        at = draw_resting(rng, world, BUTTON, height=TOP)
        return Start({BUTTON: (np.append(at[:2], 0.0), draw_yaw(rng))})

    def observe(self, world: World) -> Observed:
        """Return the hand, the middle of the cap's top, and the vector from hand to cap."""
        cap = world.at(CAP)
        return {**observe_hand(world), CAP: cap, "cap_from_ee": cap - world.ee.position}

    def error(self, world: World) -> float:
        """Return how far the cap is from its stop [m]."""
        return TRAVEL - pressed(world)

    def progress(self, world: World) -> float:
        """Return progress of getting over the button and pressing it."""
        off = _off(world)
        if pressed(world) > STOPPED and off < OVER:
            return 0.7 + 0.3 * pressed(world) / TRAVEL
        above = max(0.0, world.ee.position[2] - TOP - TIP)
        height = FUNNEL.over(off)
        return 0.7 * nearness(off + abs(above - height) + height)
