"""Insert: a square peg into a hole, from wherever it stands or lies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.robots.reach import ARRIVES
from manip_il.sim.world import Scene, World
from manip_il.tasks.grasp import OPEN_SLACK, angle_between, lie_of
from manip_il.tasks.ladder import CLOSED, nearness
from manip_il.tasks.objects import GREY, RED, add_furniture, add_object, add_part
from manip_il.tasks.reach import observe_hand
from manip_il.tasks.starts import draw_resting_place, draw_until, draw_yaw
from manip_il.tasks.task import Limits, Observed, Rung, Start, Target

F64 = NDArray[np.float64]

PEG, HOLE = "peg", "hole"
SIDE, LENGTH, MASS = 0.03, 0.10, 0.08  # of the peg [m], [m], [kg]
DEPTH, WALL = 0.04, 0.018  # of the hole, and thickness of the walls around it [m]
FROM_END = 0.03  # of the grip from the peg's upper end [m]
LOWEST = 0.024  # of the hand over the table at a peg that lies [m]
STANDS = 0.4  # tilt under which the peg is grasped as it stands, from above [rad]
LEAN = math.radians(60)  # of the hand, back over the outer end of a peg that lies: less is left to turn [rad]
LEAN_BY_ROOM = 3.0  # the same at most, by how much farther the arm reaches: its wrist is that far out [rad/m]
AT_GRIP, CLOSING = (0.012, 0.012, 0.012), (0.016, 0.020, 0.016)  # of the hand off its grip: close, keep closing [m]
AT_ANGLE = 0.25  # [rad]
OVER, SLOPE, FREE = 0.075, 2.0, 0.006  # of the hand over its grip while it is not there; per error; error without [m]
BARE = 0.012  # of the hand beside a held peg's faces and beyond its ends [m]
LIFT, LIFT_SLOPE = 0.025, 2.5  # of the peg's lower end over the rim; per error
ANGLE_AS_LENGTH = 0.03  # what a radian counts for in these errors [m/rad]
SLOW, FAST = 0.010, 0.06  # how far ahead of the hand its target runs, at the rim and far from it [m]
FITS = 0.4  # share of the play that errors may take of a peg that goes down into the hole
LET_GO, RELEASE = 0.012, 0.03  # opening beyond the width of a peg that is free, and commanded to free it [m]
CLEAR = 0.03  # of the hand over the peg once it has let go [m]
AT_RIM, GENTLE = 0.005, 0.003  # of the lower end from the rim's height, where the hand presses down by so much [m]
EXACT = 0.02  # error under which the hand is placed exactly [m]
IN = 0.003  # of the peg's lower end off the hole's floor: inserted [m]
ASIDE = (math.radians(55), math.radians(70))  # yaw, to either side, at which a hand that sets the peg up points: wrists get there [rad]
NEAR_MIDDLE = 0.05  # of the workspace, along x: where the peg is set up [m]
FROM_HOLE = 0.11  # of the peg, where it is set up, from the hole [m]
ASLANT = 0.40  # of the hand off straight down: it does not carry the peg like that, but sets it up [rad]
ON_TABLE = 0.004  # of the lower end over the table: the peg stands there [m]
IN_AIR, BESIDE = 0.006, 0.026  # of a falling peg over the table, and of its axis off the hand that catches it [m]
APART = 0.14  # of the peg from the hole at the start [m]
NOT_FARTHER = 0.05  # of a peg that lies beyond the workspace's middle at the start [m]
_QUARTER = math.pi / 2


class Grip(NamedTuple):
    """How the hand grips the peg: pose of `ee`, position (3,) [m] and rotation (3, 3).

    off: how far the hand is from being over it, with its angle [m]; angle [rad]; height: how high over it the hand has
    to be for that [m]. open_enough: the fingers pass on both sides of the peg.
    """

    position: F64
    rotation: F64
    off: float
    angle: float
    height: float
    open_enough: bool


class Way(NamedTuple):
    """What is left to do for a peg in the hand.

    rotation: of the hand when the peg stands upright, in line with the hole if it is for that, (3, 3); angle: to there
    [rad]. off: sideways to there [m], (2,). error: both together [m]. low: of the peg's lower end over the table, when
    it stands [m].
    """

    rotation: F64
    angle: float
    off: F64
    error: float
    low: float


def hand_at(yaw: float, pitch: float) -> F64:
    """Return rotation of `ee` with the hand pointing down at 0 `pitch`, and along `yaw` at a quarter turn; (3, 3)."""
    c, s = math.cos(yaw), math.sin(yaw)
    along, up = np.array([c, s, 0.0]), np.array([0.0, 0.0, 1.0])
    z = math.sin(pitch) * along - math.cos(pitch) * up
    x = math.cos(pitch) * along + math.sin(pitch) * up
    return np.stack([x, np.cross(z, x), z], axis=1)


def azimuth(rotation: F64) -> float:
    """Return the yaw of `hand_at` that a hand (3, 3) has, whatever its pitch [rad]: its fingers' motion is level."""
    return math.atan2(rotation[0, 1], -rotation[1, 1])


def lower_end(world: World) -> F64:
    """Return the middle of the peg's lower end, (3,) [m]."""
    peg = world.pose(PEG)
    axis = peg.rotation[:, 2]
    return peg.position - math.copysign(world.extents(PEG)[2] / 2, axis[2]) * axis


def upper_axis(world: World) -> F64:
    """Return the direction along the peg to the end that is to be its upper one, (3,)."""
    return world.remember("upper", lambda: _upper_axis(world))


def _upper_axis(world: World) -> F64:
    """In the hand the end that it holds; else the upper end, or of a peg that lies the one away from the robot."""
    peg, ee = world.pose(PEG), world.ee
    axis = peg.rotation[:, 2]
    if _stands(world):
        return math.copysign(1.0, axis[2]) * axis
    if held(world):
        return math.copysign(1.0, float(axis @ (ee.position - peg.position))) * axis
    at = azimuth(ee.rotation)
    return min((axis, -axis), key=lambda a: _far_turn(math.atan2(a[1], a[0]), at))


def _far_turn(yaw: float, at: float) -> float:
    """How unwelcome a yaw is: far from the hand's, and from straight ahead."""
    return abs(yaw - at) + 0.5 * abs(yaw)


def _stands(world: World) -> bool:
    return abs(world.pose(PEG).rotation[2, 2]) > math.cos(STANDS)


def held(world: World) -> bool:
    """Return whether both fingers touch the peg, and the hand is between its faces and its ends."""
    peg = world.pose(PEG)
    x, y, z = np.abs(peg.rotation.T @ (world.ee.position - peg.position)).tolist()
    side, _, length = world.extents(PEG)
    return max(x, y) < side / 2 + BARE and z < length / 2 + BARE and world.touched(PEG)


def is_in(world: World) -> bool:
    """Return whether the peg is at the hole's floor."""
    return math.dist(lower_end(world), world.pose(HOLE).position) < IN


def grip_of(world: World) -> Grip:
    """Return how the hand grips the peg as it lies or stands; computed once a state."""
    return world.remember("grip", lambda: _grip(world))


def _grip(world: World) -> Grip:
    ee, peg = world.ee, world.pose(PEG)
    width, _, length = world.extents(PEG)
    axis = upper_axis(world)
    position = peg.position + (length / 2 - FROM_END) * axis
    if _stands(world):
        at = azimuth(ee.rotation)
        yaw = min((grasp[0] for grasp in lie_of(world, PEG).grasps), key=lambda yaw: _far_turn(yaw, at))
        rotation = hand_at(yaw, 0.0)
    else:
        room = _farthest(world.scene) - position[0]
        lean = min(LEAN, LEAN_BY_ROOM * max(0.0, room))
        rotation = hand_at(math.atan2(axis[1], axis[0]), -lean)
    position = np.array([*position[:2], max(position[2], LOWEST)])
    angle = angle_between(ee.rotation, rotation)
    off = math.hypot(*(position - ee.position)[:2]) + 0.05 * max(0.0, angle - 0.1)
    height = min(OVER, SLOPE * max(0.0, off - FREE))
    return Grip(position, rotation, off, angle, height, world.opening >= width + OPEN_SLACK)


def _is_aslant(world: World) -> bool:
    return -world.ee.rotation[2, 2] < math.cos(ASLANT)


@cache
def _farthest(scene: Scene) -> float:
    """How far from the robot along x the hand gets to the table [m]."""
    x, y = scene.robot.workspace.centre
    while scene.reach.error((x + 0.01, y, 0.0)) < ARRIVES:
        x += 0.01
    return x


def to_hole(world: World) -> Way:
    """Return what is left to do for a peg that hangs from the hand; computed once a state."""
    return world.remember("to hole", lambda: _to_hole(world))


def _to_hole(world: World) -> Way:
    """Turn the peg with the hand, as it lies in it, to one of the four ways in which it fits the hole."""
    peg, hole, hand = world.pose(PEG), world.pose(HOLE), world.ee.rotation
    in_hand = peg.rotation.T @ hand
    flip = 1.0 if float(upper_axis(world) @ peg.rotation[:, 2]) > 0 else -1.0
    turns = (_quarter(hole.rotation, k, flip) @ in_hand for k in range(4))
    best = min(turns, key=lambda turn: angle_between(hand, turn) + abs(azimuth(turn)))
    return _way(world, best, lambda world, end: hole.position)


def to_stand(world: World) -> Way:
    """Return what is left to do for a peg in the hand that is to stand on the table first; computed once a state."""
    return world.remember("to stand", lambda: _to_stand(world))


def _to_stand(world: World) -> Way:
    """Turn the peg upright on the shortest way, and the hand to one side; near the middle, and not at the hole."""
    hand, axis = world.ee.rotation, upper_axis(world)
    upright = _upright(axis) @ hand
    y, at = float(world.ee.position[1]) - world.scene.robot.workspace.centre[1], azimuth(hand)
    least, most = ASIDE
    yaw = min(
        (math.copysign(min(most, max(least, side * at)), side) for side in (1.0, -1.0)),
        key=lambda yaw: abs(yaw - at) + 8.0 * max(0.0, math.copysign(y, yaw * y)),
    )
    turn = yaw - azimuth(upright)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ upright
    return _way(world, rotation, _free_place)


def _upright(axis: F64) -> F64:
    """The rotation on the shortest way that turns an axis up, (3, 3)."""
    x, y, z = axis.tolist()
    if z < -0.99:
        return np.diag([1.0, -1.0, -1.0])
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])


def _free_place(world: World, end: F64) -> F64:
    """Where a peg is set up: on the table, nearest to where its lower end (3,) would be, (3,) [m]."""
    x, y, _ = end.tolist()
    middle = world.scene.robot.workspace.centre[0]
    at = np.array([min(middle + NEAR_MIDDLE, max(middle - NEAR_MIDDLE, x)), y, 0.0])
    from_hole = at - world.pose(HOLE).position
    distance = math.hypot(from_hole[0], from_hole[1])
    return at + max(0.0, FROM_HOLE / max(distance, 1e-6) - 1) * from_hole


def _way(world: World, rotation: F64, to: Callable[[World, F64], F64]) -> Way:
    """What is left when the peg turns with the hand to a rotation (3, 3). to: where its lower end goes from a point."""
    ee, peg = world.ee, world.pose(PEG)
    angle = angle_between(ee.rotation, rotation)
    end = peg.position - world.extents(PEG)[2] / 2 * upper_axis(world)
    turned = ee.position + rotation @ (ee.rotation.T @ (end - ee.position))  # the lower end, once the peg is upright
    off = (to(world, turned) - turned)[:2]
    return Way(rotation, angle, off, math.hypot(*off) + ANGLE_AS_LENGTH * angle, float(turned[2]))


def _quarter(hole: F64, k: int, flip: float) -> F64:
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[k]
    return hole @ np.array([[c, -s * flip, 0.0], [s, c * flip, 0.0], [0.0, 0.0, flip]])


def _is_entered(world: World) -> bool:
    way = to_hole(world)
    return way.low < DEPTH - 0.002 and math.hypot(*way.off) < 0.006


def _play(world: World) -> float:
    return 2 * float(world.model.geom("hole left").pos[1] - WALL / 2) - world.extents(PEG)[0]


def _lift(world: World) -> float:
    """How high over the hole's floor the peg's lower end is to be [m]."""
    error = to_hole(world).error - FITS * world.remember("play", lambda: _play(world))
    if _is_entered(world) or error <= 0:
        return 0.0
    return DEPTH + 0.0005 + min(LIFT, LIFT_SLOPE * error)


def _bring(world: World) -> Target:
    """Up, over the hole, the nearer the lower, and slowly down into it."""
    way = to_hole(world)
    far = math.hypot(*way.off) > 0.01
    return _move(world, way, _lift(world) - way.low, sideways_at=0.015 if far else math.inf, exact=way.error < EXACT)


def _set_up(world: World) -> Target:
    """Up and upright, to a free place; then down on the table."""
    way = to_stand(world)
    return _move(world, way, _set_up_height(way) - way.low, sideways_at=0.03)


def _set_up_height(way: Way) -> float:
    return min(LIFT, LIFT_SLOPE * max(0.0, way.error - 0.006)) - 0.001


def _move(world: World, way: Way, missing: float, sideways_at: float, exact: bool = False) -> Target:
    """Move the peg with the hand. missing: height [m]; sideways_at: how little may be missing for a move sideways."""
    sideways = min(1.0, max(0.0, 1.0 - missing / sideways_at))
    turn = 0.6 * min(1.0, max(0.05, 1.0 - missing / 0.06))
    if abs(way.low - DEPTH) < AT_RIM:
        missing = max(missing, -GENTLE)
    position = world.ee.position + np.array([*(sideways * way.off), max(missing, -SLOW)])
    step = min(FAST, SLOW + max(0.0, way.error - 0.02))
    return Target(position, way.rotation, CLOSED, max_step=step, max_turn=turn, exact=exact)


def _is_up(world: World) -> bool:
    """Whether the peg stands on the table in a hand that does not point down, or is just above that."""
    stands = float(upper_axis(world)[2]) > math.cos(0.15) and lower_end(world)[2] < ON_TABLE
    return stands and _is_aslant(world) and _hand_is_at(world)


def _hand_is_at(world: World) -> bool:
    x, y, z = (world.ee.position - lower_end(world)).tolist()
    return math.hypot(x, y) < 0.03 and z < world.extents(PEG)[2] + CLEAR


def _falls(world: World) -> bool:
    """Whether the peg, between the fingers or just under their tips, neither stands nor lies."""
    peg, ee = world.pose(PEG), world.ee
    way = ee.position - peg.position
    along = float(peg.rotation[:, 2] @ way)
    beside = ee.rotation.T @ (way - along * peg.rotation[:, 2])
    between = abs(beside[1]) < world.opening / 2 and math.hypot(*beside) < BESIDE
    if not between or abs(along) > world.extents(PEG)[2] / 2:
        return False
    return lie_of(world, PEG).tilt > 0.06 or float(peg.position[2]) - lie_of(world, PEG).tall / 2 > IN_AIR


def _catch(world: World) -> Target:
    """Close the fingers, and go with the peg."""
    peg, ee = world.pose(PEG), world.ee
    axis = upper_axis(world)
    along = float(axis @ (ee.position - peg.position))
    down = (world.extents(PEG)[2] / 2 - FROM_END - along) * axis
    return Target(ee.position + down, ee.rotation.copy(), CLOSED)


def _let_stand(world: World) -> Target:
    """Open the fingers, then rise straight up."""
    ee, width = world.ee, world.extents(PEG)[0]
    free = world.opening > width + LET_GO and not world.touched(PEG)
    up = 0.1 if free else 0.0
    return Target(ee.position + [0.0, 0.0, up], ee.rotation.copy(), min(width + RELEASE, world.most_opening), max_step=0.04)


def _at_grip(world: World) -> bool:
    grip = grip_of(world)
    box = AT_GRIP if grip.open_enough else CLOSING
    offset = np.abs(grip.rotation.T @ (world.ee.position - grip.position))
    return bool((offset < box).all()) and grip.angle < AT_ANGLE


def _close(world: World) -> Target:
    grip = grip_of(world)
    return Target(grip.position, grip.rotation, CLOSED)


def _approach(world: World) -> Target:
    """Over the grip and down to it, fingers open; straight up if too low beside it."""
    grip, ee = grip_of(world), world.ee.position
    height = grip.height if grip.open_enough else max(grip.height, OVER)
    too_low = grip.position[2] + height - ee[2]
    sideways = min(1.0, max(0.0, 1.0 - too_low / 0.03))
    position = np.append(ee[:2] + sideways * (grip.position - ee)[:2], grip.position[2] + height)
    return Target(position, grip.rotation, world.most_opening)


def _hold(world: World) -> Target:
    if held(world):
        return _bring(world)
    return Target(world.ee.position.copy(), world.ee.rotation.copy(), CLOSED)


def _hangs(world: World) -> bool:
    """Whether the peg hangs from a hand that points down."""
    return held(world) and not _is_aslant(world) and _stands(world)


_RUNGS = (
    Rung("inserted", "the peg is at the floor of the hole", is_in, _hold),
    Rung("insert", "the peg hangs from the hand and goes down into the hole",
         lambda w: _hangs(w) and _lift(w) < DEPTH, _bring),
    Rung("carry", "the peg hangs from the hand, on its way to over the hole", _hangs, _bring),
    Rung("let_stand", "the peg has been set up on the table, and the hand lets go of it", _is_up, _let_stand),
    Rung("set_up", "the peg is held aslant, and set up on the table", held, _set_up),
    Rung("catch", "the peg falls between the open fingers, and they close", _falls, _catch),
    Rung("grasp", "the fingers are around the peg and close, but do not hold it yet", _at_grip, _close),
    Rung("open", "the fingers are closed, or not open wide enough to go around the peg",
         lambda w: not grip_of(w).open_enough, _approach),
    Rung("descend", "the hand goes down to the peg", lambda w: grip_of(w).height < OVER, _approach),
    Rung("approach", "the hand is on its way to above the peg", lambda w: True, _approach),
)  # fmt: skip


@dataclass(frozen=True)
class Insert:
    """Put a peg into the hole that it fits. play: how much wider the hole is than the peg [m]."""

    name: str = "insert"
    instruction: str = "Put the peg into the hole."
    play: float = 0.002
    limits: Limits = field(default=Limits(tolerance=0.004, horizon=250))
    objects: tuple[str, ...] = (PEG,)
    grasped: tuple[str, ...] = (PEG,)
    rungs: tuple[Rung, ...] = _RUNGS

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the peg, and four walls around the hole."""
        add_object(spec, PEG, "box", [SIDE / 2, SIDE / 2, LENGTH / 2], MASS, RED)
        hole = add_furniture(spec, HOLE)
        inner = (SIDE + self.play) / 2
        for side, sign in (("left", 1), ("right", -1)):
            at = sign * (inner + WALL / 2)
            add_part(hole, f"hole {side}", (inner + WALL, WALL / 2, DEPTH / 2), (0, at, DEPTH / 2), GREY)
        for side, sign in (("far", 1), ("near", -1)):
            at = sign * (inner + WALL / 2)
            add_part(hole, f"hole {side}", (WALL / 2, inner, DEPTH / 2), (at, 0, DEPTH / 2), GREY)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw where the hole is and its yaw, and the peg apart from it, half of the time lying, at any yaw."""
        centre = world.scene.robot.workspace.centre
        side, _, length = world.extents(PEG)

        hole = draw_resting_place(rng, world, HOLE, 2 * DEPTH) * [1, 1, 0]
        lies = rng.uniform() < 0.5
        height = (side if lies else length) / 2

        farthest = centre[0] + (NOT_FARTHER if lies else math.inf)

        def fits(at: F64) -> bool:
            return math.dist(at[:2], hole[:2]) > APART and at[0] < farthest

        peg = draw_until(lambda: draw_resting_place(rng, world, PEG, height), fits, world, PEG)
        turn = draw_yaw(rng, np.pi)
        if lies:
            mujoco.mju_mulQuat(turn, turn.copy(), np.array([math.cos(_QUARTER / 2), 0.0, math.sin(_QUARTER / 2), 0.0]))
        return Start({PEG: (peg, turn), HOLE: (hole, draw_yaw(rng))})

    def observe(self, world: World) -> Observed:
        """Return hand, peg and hole, the ways between them, and how the hand is to turn for the peg to fit."""
        peg, hole, lie = world.pose(PEG).position, world.pose(HOLE), lie_of(world, PEG)
        yaw = math.atan2(hole.rotation[1, 0], hole.rotation[0, 0])
        way = to_hole(world)
        return {
            **observe_hand(world),
            PEG: peg,
            "peg.axis": upper_axis(world),
            "peg.cos4yaw": math.cos(4 * lie.yaw),
            "peg.sin4yaw": math.sin(4 * lie.yaw),
            HOLE: hole.position,
            "hole.cos4yaw": math.cos(4 * yaw),
            "hole.sin4yaw": math.sin(4 * yaw),
            "peg_from_ee": peg - world.ee.position,
            "hole_from_peg": hole.position - lower_end(world),
            "turn": _rotation_vector(way.rotation @ world.ee.rotation.T),
        }

    def error(self, world: World) -> float:
        """Return the distance of the peg's lower end from the middle of the hole's floor [m]."""
        return math.dist(lower_end(world), world.pose(HOLE).position)

    def progress(self, world: World) -> float:
        """Return progress of grasping, carrying and inserting, by the way that is left."""
        if is_in(world):
            return 1.0
        grip = grip_of(world)
        above = float(world.ee.position[2] - grip.position[2])
        near = nearness(grip.off + abs(above - grip.height) + grip.height)
        if _hangs(world):
            way = to_hole(world)
            if _is_entered(world):
                return 0.9 + 0.1 * max(0.0, 1.0 - way.low / DEPTH)
            return 0.6 + 0.3 * nearness(math.hypot(*way.off) + abs(_lift(world) - way.low) + 0.1 * way.angle)
        if _is_up(world):
            return 0.33 + 0.07 * min(1.0, max(0.0, above / (FROM_END + CLEAR)))
        if held(world):
            way = to_stand(world)
            return 0.2 + 0.12 * nearness(math.hypot(*way.off) + abs(_set_up_height(way) - way.low) + 0.1 * way.angle)
        return 0.41 + 0.18 * near if _stands(world) else 0.18 * near


def _rotation_vector(rotation: F64) -> F64:
    """Return the axis of a rotation (3, 3) times its angle, (3,) [rad]."""
    quaternion, vector = np.empty(4), np.empty(3)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector
