"""Insert: put a square peg, which stands or lies anywhere on the table, into a hole."""

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import angle_across, angle_ahead, angle_between, angle_off_vertical
from manip_il.sim.task import Observed, Rung, Start, Target, Task
from manip_il.sim.world import World
from manip_il.tasks.grasp import lie_of, once_per_state
from manip_il.tasks.ladder import CLOSED, nearness
from manip_il.tasks.objects import (
    GREY,
    RED,
    add_furniture,
    add_object,
    add_part,
    draw_resting,
    draw_until,
    draw_yaw,
    observe_hand,
    product,
    turn_left,
)
from manip_il.tasks.peg import (
    HOLE,
    LENGTH,
    LIFT,
    LIFT_SLOPE,
    PEG,
    PEG_RUNGS,
    SIDE,
    Motion,
    hangs,
    holds_peg,
    lower_end,
    motion_to,
    move,
    peg_progress,
    upper_axis,
)

MASS = 0.15  # of the peg [kg]
DEPTH, WALL = 0.03, 0.018  # depth of the hole, and thickness of the walls around it [m]
# chamfer of the walls' inner edges, as high as wide [m], and its friction
CHAMFER, SLIPPERY = 0.005, 0.05
GUIDED = 0.003  # peg error up to which the chamfer guides it into the hole [m]
# within `AT_RIM` of the rim's height, the peg is lowered by at most `GENTLE` [m]
AT_RIM, GENTLE = 0.005, 0.003
EXACT = 0.02  # error below which the hand is placed exactly [m]
IN = 0.003  # distance from the hole's floor at which the peg is inserted [m]
SIDES, TILTED = (0.6, 1.75), 0.5  # best yaws of a hand tilted by `TILTED` [rad]
STRAIN = 4.0  # weight of other yaws
# largest distance of the hole from the workspace's middle towards the robot, for a tilted hand [m]
NOT_NEARER = 0.10
APART = 0.14  # least distance of peg and hole at the start [m]
NOT_FARTHER = 0.05  # how far beyond the workspace's middle a lying peg may start [m]
_QUARTER = math.pi / 2


def is_inserted(world: World) -> bool:
    """Return whether the peg has reached the hole's floor."""
    return math.dist(lower_end(world), world.at(HOLE)) < IN


@once_per_state
def to_hole(world: World) -> Motion:
    """Return the remaining motion of a hanging peg into the hole.

    Of the four rotations that fit, it takes the easiest.
    """
    peg, hole = world.pose(PEG).rotation, world.pose(HOLE)
    hand = world.ee.rotation
    flip = 1.0 if upper_axis(world) @ peg[:, 2] > 0 else -1.0
    quarters = (
        np.array([[c, -s * flip, 0.0], [s, c * flip, 0.0], [0.0, 0.0, flip]])
        for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))
    )
    in_hand = peg.T @ hand
    turns = (hole.rotation @ quarter @ in_hand for quarter in quarters)
    best = min(turns, key=lambda turn: angle_between(hand, turn) + _strain(turn))
    return motion_to(world, best, lambda world, end: hole.position)


def _strain(hand: F64) -> float:
    """Cost of a hand's yaw, in radians of turning: a tilted hand should point neither ahead nor
    backwards.
    """
    tilt, yaw = angle_off_vertical(hand), abs(angle_across(hand))
    tilted, (least, most) = min(1.0, tilt / TILTED), SIDES
    return (1 - tilted) * yaw + tilted * STRAIN * max(0.0, least - yaw, yaw - most)


def _is_entered(world: World) -> bool:
    return to_hole(world).low < DEPTH - 0.002 and to_hole(world).distance < 0.006


def _lift(world: World) -> float:
    """Target height of the peg's lower end over the hole's floor [m]."""
    error = to_hole(world).error - GUIDED
    if _is_entered(world) or error <= 0:
        return 0.0
    return DEPTH + 0.0005 + min(LIFT, LIFT_SLOPE * error)


def _bring(world: World) -> Target:
    """Lift the peg over the hole, lower it on the way, and slowly insert it."""
    motion = to_hole(world)
    missing = _lift(world) - motion.low
    if abs(motion.low - DEPTH) < AT_RIM:
        missing = max(missing, -GENTLE)
    sideways_at = 0.015 if motion.distance > 0.01 else math.inf
    return move(world, motion, missing, sideways_at, exact=motion.error < EXACT)


@dataclass(frozen=True)
class Insert(Task):
    """Put a peg into a hole that it fits.

    Attributes:
        play: How much wider the hole is than the peg [m].
    """

    name: str = "insert"
    instruction: str = "Put the peg into the hole."
    play: float = 0.002
    place = "the hole"
    subtasks = MappingProxyType(
        {
            "let_stand": "let {it} stand",
            "insert": "insert {it} into {place}",
            "inserted": "hold {it} in {place}",
        }
    )
    tolerance = 0.004
    horizon = 600
    objects = (PEG,)
    grasped = (PEG,)
    rungs = (
        Rung(
            "inserted",
            is_inserted,
            lambda w: _bring(w) if holds_peg(w) else Target(*w.ee, CLOSED),
        ),
        Rung("insert", lambda w: hangs(w) and _lift(w) < DEPTH, _bring),
        Rung("carry", hangs, _bring),
        *PEG_RUNGS,
    )

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the peg, and four walls around the hole."""
        add_object(spec, PEG, "box", [SIDE / 2, SIDE / 2, LENGTH / 2], MASS, RED)
        hole = add_furniture(spec, HOLE)
        inner = (SIDE + self.play) / 2
        for side, quarter in (("left", 1), ("far", 0), ("right", 3), ("near", 2)):
            _add_wall(hole, f"hole {side}", quarter * _QUARTER, inner)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the hole's place and yaw, and the peg away from it.

        The peg lies half of the time, and has any yaw.
        """
        centre = world.robot.workspace.centre
        side, _, length = world.extents(PEG)

        def draw_hole() -> F64:
            return draw_resting(rng, world, HOLE, height=2 * DEPTH) * [1, 1, 0]

        hole = draw_until(draw_hole, lambda at: at[0] > centre[0] - NOT_NEARER, world, HOLE)
        lies = rng.uniform() < 0.5
        height, farthest = (side, centre[0] + NOT_FARTHER) if lies else (length, math.inf)

        def fits(at: F64) -> bool:
            return math.dist(at[:2], hole[:2]) > APART and at[0] < farthest

        peg = draw_until(lambda: draw_resting(rng, world, PEG, height=height / 2), fits, world, PEG)
        turn = draw_yaw(rng, np.pi)
        if lies:
            turn = product(turn, _turn_ahead(_QUARTER))
        return Start({PEG: (peg, turn), HOLE: (hole, draw_yaw(rng))})

    def observe(self, world: World) -> Observed:
        """Return the hand, the peg, the hole, and the vectors between them.

        The hand's remaining rotation vector [rad] is returned as well.
        """
        peg, hole = world.at(PEG), world.pose(HOLE)
        peg_yaw, yaw = lie_of(world, PEG).yaw, angle_ahead(hole.rotation)
        return {
            **observe_hand(world),
            PEG: peg,
            "peg.axis": upper_axis(world),
            "peg.cos4yaw": math.cos(4 * peg_yaw),
            "peg.sin4yaw": math.sin(4 * peg_yaw),
            HOLE: hole.position,
            "hole.cos4yaw": math.cos(4 * yaw),
            "hole.sin4yaw": math.sin(4 * yaw),
            "peg_from_ee": peg - world.ee.position,
            "hole_from_peg": hole.position - lower_end(world),
            "turn": to_hole(world).turn,
        }

    def error(self, world: World) -> float:
        """Return the distance of the peg's lower end from the middle of the hole's floor [m]."""
        return math.dist(lower_end(world), world.at(HOLE))

    def progress(self, world: World) -> float:
        """Return progress of grasping, carrying and inserting, by the distance left."""
        if is_inserted(world):
            return 1.0
        if not hangs(world):
            return 0.6 * peg_progress(world)
        motion = to_hole(world)
        if _is_entered(world):
            return 0.9 + 0.1 * max(0.0, 1.0 - motion.low / DEPTH)
        height = max(0.0, _lift(world) - DEPTH)
        rest = motion.distance + abs(DEPTH + height - motion.low) + height + 0.1 * motion.angle
        return 0.6 + 0.3 * nearness(rest)


def _turn_ahead(angle: float) -> F64:
    """The quaternion, wxyz (4,), of a turn about y, from z towards x [rad]."""
    return np.array([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])


def _add_wall(hole: Any, name: str, yaw: float, inner: float) -> None:
    """Add a chamfered wall at a yaw [rad] from the hole's middle.

    inner: distance from there to its inner face [m].
    """
    height, steep = DEPTH - CHAMFER, math.pi / 4
    c, s = math.cos(yaw), math.sin(yaw)
    out, thick = inner + WALL / 2, CHAMFER / 2
    half = (WALL / 2, inner + WALL, height / 2)
    add_part(hole, name, half, (c * out, s * out, height / 2), GREY).quat = turn_left(yaw)
    out = inner + CHAMFER / 2 + thick * math.sin(steep)
    up = height + CHAMFER / 2 - thick * math.cos(steep)
    half = (CHAMFER / math.sqrt(2), inner + WALL, thick)
    edge = add_part(hole, f"{name} edge", half, (c * out, s * out, up), GREY)
    edge.quat = product(turn_left(yaw), _turn_ahead(-steep))
    edge.friction = [SLIPPERY, 0.005, 0.0001]
    edge.priority = 1
