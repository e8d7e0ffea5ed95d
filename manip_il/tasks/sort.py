"""Sort: of three cubes, put the one that the instruction names into the bin of its colour."""

import math
from functools import partial
from types import MappingProxyType

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import angle_ahead, angle_from_down, hand_down
from manip_il.sim.task import Observed, Rung, Start, Target, Task
from manip_il.sim.world import World
from manip_il.tasks.bins import (
    OVER,
    OVER_WALL,
    WALL,
    add_bin,
    drop_place,
    drop_rungs,
    is_in,
    rise_over,
)
from manip_il.tasks.grasp import grasp_of, lie_of, once_per_state, share
from manip_il.tasks.ladder import (
    CLEAR,
    CLOSED,
    approach,
    grasp_progress,
    grasp_rungs,
    is_held,
    nearness,
)
from manip_il.tasks.objects import (
    BLUE,
    FROM_HAND,
    RED,
    UPRIGHT,
    YELLOW,
    add_cube,
    add_furniture,
    draw_until,
    draw_yaw,
    observe_hand,
    observe_object,
    resting_height,
)

COLOURS = {"red": RED, "blue": BLUE, "yellow": YELLOW}
BINS = {name: f"{name}_bin" for name in COLOURS}
# an invisible mocap body: its x is the number of the named cube, its z that of the sentence
ASKED = "asked"
SENTENCES = (
    "Put the {colour} cube into the {colour} bin.",
    "Sort the {colour} cube into its bin.",
    "Place the {colour} cube in the bin of the same colour.",
    "Move only the {colour} cube to where it belongs.",
    "The {colour} cube goes into the {colour} bin.",
)
INSIDE = (0.046, 0.068)  # half a bin's inner length and width [m]
_IN_ROW = 1e-6  # distance from its place in the row beyond which a bin was moved [m]
PITCH = 0.105  # spacing of the bins, which stand in a row away from the robot [m]
SIDE = 0.19  # offset of the row from the workspace's middle, left or right [m]
# largest shift of cubes and bins along x, to where the arm reaches farthest to both sides [m]
SHIFT = 0.08
HALF = 0.018  # half a cube's edge length [m]
APART = 0.085  # least distance between cubes at the start [m]
FROM_BINS = 0.14  # least sideways distance of a cube from the row's middle at the start [m]
BEYOND = 0.15  # largest distance of a cube from the workspace's middle on the side without bins [m]
LOWER = 0.028  # how far below `drop_place` a cube is released, so that it does not bounce far [m]
STEP = 0.1  # how far the target runs ahead of the carrying hand: a fast hand drops fewer cubes [m]
SLOPE = 5.0  # slope of the path around other bins: distance from the row per distance along it
# distances from a wall, in a bin and beside it, below which fingers lack room [m]
NEAR_WALL, BY_WALL = 0.045, 0.065
NARROW = 0.024  # opening beyond the width of a cube near a bin's wall [m]
TURNED = 0.3  # near a wall: angle to the grasp beyond which the hand stays over the cube [rad]
_HIGH = 0.04  # clearance of a cube that is carried across a bin's walls [m]
_WRONG = 0.1  # error for each other cube in a bin [m]


@once_per_state
def asked(world: World) -> str:
    """Return the name of the cube that the instruction names."""
    return list(COLOURS)[round(float(world.at(ASKED)[0]))]


def _is_sorted(world: World, name: str) -> bool:
    return name == asked(world) and is_in(world, name, BINS[name], INSIDE)


def _wrong(world: World) -> int:
    """Number of other cubes that are in a bin."""
    others = COLOURS.keys() - {asked(world)}
    return sum(is_in(world, name, box, INSIDE) for name in others for box in BINS.values())


def _place(world: World) -> F64:
    """Release point of the named cube over its bin, (3,) [m]."""
    return drop_place(world, asked(world), BINS[asked(world)]) - [0.0, 0.0, LOWER]


def _to(world: World) -> F64:
    """Release point of the named cube, (3,) [m].

    Shifted off the row of bins until the cube is beside its bin.
    """
    name, place = asked(world), _place(world)
    along = abs(place[0] - world.at(name)[0])
    inwards = math.copysign(1.0, world.robot.workspace.centre[1] - place[1])
    return place + [0.0, inwards * min(FROM_BINS, SLOPE * max(0.0, along - INSIDE[0] / 2)), 0.0]


def _other_held(world: World) -> str:
    """Name of the wrong cube in the hand; "" if there is none."""
    return next((name for name in COLOURS if name != asked(world) and is_held(world, name)), "")


def _put_back(world: World) -> Target:
    """Move a wrong cube away from the bins, lower it to the table and open the fingers."""
    name = _other_held(world) or asked(world)
    _, y, z = world.at(name)
    low = z - lie_of(world, name).tall / 2
    centre, row = world.robot.workspace.centre[1], world.at(BINS[name])[1]
    inwards = FROM_BINS - abs(y - row)  # distance to move until it is off the bins
    sideways, up = 0.0, -max(0.0, low)
    if inwards > 0:
        up = WALL + _HIGH - low
        sideways = share(1.0 - up / 0.03) * math.copysign(inwards + 0.02, centre - row)
    opening = CLOSED if inwards > 0 or low > 0.008 else world.gripper.most
    return Target(world.ee.position + [0.0, sideways, up], hand_down(0.0), opening)


def _free_yaw(world: World) -> float | None:
    """Yaw at which walls leave room for the fingers, modulo half a turn [rad].

    None if there is room all around.
    """
    x, y, _ = world.at(asked(world)).tolist()
    along, across, _ = np.array([world.at(box) for box in BINS.values()]).T.tolist()
    off = abs(y - across[0])
    beyond = max(min(along) - x, x - max(along)) - PITCH / 2
    if off > INSIDE[1] + BY_WALL or beyond > BY_WALL:
        return None
    return 0.0 if beyond > 0.0 or off < INSIDE[1] - NEAR_WALL else math.pi / 2


def _approach(world: World, name: str, hover: float) -> Target:
    """Approach as for any cube, but with the fingers where no wall is in their way."""
    target, free = approach(world, name, hover), _free_yaw(world)
    if free is None:
        return target
    ee, g = world.ee, grasp_of(world, name)
    hand = angle_ahead(ee.rotation)
    yaws = (yaw for yaw, _, _, _ in lie_of(world, name).grasps)
    yaw = min(yaws, key=lambda yaw: (round(abs(math.sin(yaw - free)), 6), abs(yaw - hand)))
    low = g.at[2] + g.half + CLEAR if angle_from_down(ee.rotation, yaw) > TURNED else 0.0
    return Target(
        np.maximum(target.position, [-np.inf, -np.inf, low]), hand_down(yaw), g.width + NARROW
    )


def _middle(world: World) -> tuple[float, float]:
    """Middle (x, y) [m] of cubes and bins, chosen so that the arm can also pick up a dropped
    cube.
    """
    x, y = world.robot.workspace.centre
    line = [(x, y + across, z) for across in (-0.2, -0.1, 0.0, 0.1, 0.2) for z in (0.03, 0.15)]
    shifts = [
        shift
        for shift in np.arange(-0.35, 0.35, 0.025).tolist()
        if world.reach.has_each(np.array(line) + [shift, 0.0, 0.0]).all()
    ]
    middle = (shifts[0] + shifts[-1]) / 2 if shifts else 0.0
    return x + min(SHIFT, max(-SHIFT, middle)), y


_LET_GO, _CARRY = drop_rungs(
    asked, _to, _is_sorted, tuple(COLOURS), OVER_WALL._replace(max_step=STEP)
)


class Sort(Task):
    """Put the cube that the instruction names into the bin of its colour.

    The other cubes stay on the table.
    """

    name = "sort"
    instruction = "Put the cube that is named into the bin of its colour."
    nouns = MappingProxyType({name: f"{name} cube" for name in COLOURS})
    place = "the bin of its colour"
    tolerance = 0.005
    horizon = 250
    objects = tuple(COLOURS)
    grasped = tuple(COLOURS)
    sizes = (0.03, 0.04)
    rungs = (
        _LET_GO,
        Rung("done", lambda w: _is_sorted(w, asked(w)), lambda w: rise_over(w, BINS[asked(w)])),
        _CARRY,
        Rung("put_back", lambda w: bool(_other_held(w)), _put_back),
        *grasp_rungs(asked, OVER, _approach),
    )

    def instruction_in(self, world: World) -> str:
        """Return the instruction of a world's episode."""
        number = round(float(world.at(ASKED)[2])) % len(SENTENCES)
        return SENTENCES[number].format(colour=asked(world))

    def moved(self, world: World, phase: str) -> str:
        """Return the named cube, or a wrong one that is put back.

        Args:
            world: The world to look at.
            phase: Name of the phase that it is in.
        """
        return _other_held(world) or asked(world)

    def objects_in(self, world: World) -> tuple[str, ...]:
        """Return the named cube; the others may lie out of reach."""
        return (asked(world),)

    def unsound(self, world: World) -> str:
        """Return why there is no sound label, or "" if there is one.

        There is none if some bins were moved without the others and do not stand in a row.
        """
        bins = np.array(sorted(world.at(box).tolist() for box in BINS.values()))
        row = bins[0] + np.outer(np.arange(len(bins)), [PITCH, 0.0, 0.0])
        return "" if np.abs(bins - row).max() < _IN_ROW else "the bins do not stand in a row"

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the cubes, a bin for each, and the body that encodes which one is named."""
        for name, colour in COLOURS.items():
            add_cube(spec, name, HALF, 0.05, colour)
            add_bin(spec, BINS[name], INSIDE, colour)
        add_furniture(spec, ASKED).pos = [0, 0, 0]

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw which cube is named, the sentence, the bins' side and order, and the cubes.

        The cubes are apart, at any yaw.
        """
        number, sentence = float(rng.integers(len(COLOURS))), float(rng.integers(len(SENTENCES)))
        poses: dict[str, tuple[F64, F64]] = {ASKED: (np.array([number, 0.0, sentence]), UPRIGHT)}
        (x, y), space = _middle(world), world.robot.workspace
        side = rng.choice([-1.0, 1.0])
        for place, name in enumerate(rng.permutation(list(BINS.values())).tolist()):
            poses[name] = np.array([x + PITCH * (place - 1), y + side * SIDE, 0.0]), UPRIGHT

        def draw_place(name: str) -> F64:  # away from the bins
            along = rng.uniform(-1, 1) * space.half_width
            across = side * rng.uniform(-BEYOND, SIDE - FROM_BINS)
            return np.array([x + along, y + across, resting_height(world, name)])

        def fits(at: F64) -> bool:
            others = [poses[name][0] for name in COLOURS if name in poses]
            apart = all(math.dist(at, other) > APART for other in others)
            return apart and math.dist(at[:2], space.centre) > FROM_HAND and world.reach.has(at)

        for name in COLOURS:
            at = draw_until(partial(draw_place, name), fits, world, name)
            poses[name] = at, draw_yaw(rng)
        return Start(poses)

    def observe(self, world: World) -> Observed:
        """Return the hand, which cube is named, its pose, and all positions of cubes and bins.

        The vectors from the named cube to its bin and to its release point are returned as well.
        """
        name = asked(world)
        return {
            **observe_hand(world),
            **{f"{ASKED}.{other}": float(other == name) for other in COLOURS},
            **observe_object(world, name, "cube"),
            "bin_from_cube": world.at(BINS[name]) - world.at(name),
            "place_from_cube": _to(world) - world.at(name),
            **{body: world.at(body) for body in (*COLOURS, *BINS.values())},
        }

    def error(self, world: World) -> float:
        """Return the named cube's distance from its bin's middle [m], 0 inside.

        Each other cube in a bin adds 0.1 m.
        """
        name = asked(world)
        off = math.dist(world.at(name), world.at(BINS[name]))
        return (0.0 if _is_sorted(world, name) else off) + _WRONG * _wrong(world)

    def progress(self, world: World) -> float:
        """Return progress of grasping the named cube and bringing it to its bin.

        The path leads around the other cubes.
        """
        name = asked(world)
        if _is_sorted(world, name):
            return 0.95 if _wrong(world) else 1.0
        if is_held(world, name):
            along, across, up = (_place(world) - world.at(name)).tolist()
            lift = OVER_WALL.over(max(0.0, math.hypot(along, across) - INSIDE[0]))
            return 0.5 + 0.4 * nearness(abs(along) + abs(across) + max(0.0, up + lift))
        return 0.45 * grasp_progress(world, name, OVER)
