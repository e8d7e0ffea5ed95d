"""How a downward hand can grasp an object as it lies, from the symmetry of its shape."""

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, NamedTuple, cast

import mujoco

from manip_il.mdp import F64
from manip_il.robots.geometry import angle_off_vertical
from manip_il.sim.rests import DEEPEST, LEAST_ROOM, Hull
from manip_il.sim.world import World

HOVER = 0.055  # clearance above the object's top before the hand is over it [m]
FUNNEL_RADIUS = 0.010  # misalignment up to which the hand may be all the way down [m]
FUNNEL_SLOPE = 2.0  # height of the hand per misalignment beyond that
ANGLE_AS_LENGTH = 0.05  # misalignment that a radian of orientation error counts as [m/rad]
ANGLE_FREE = 0.1  # orientation error that counts for nothing [rad]
TIGHT = 0.35  # share of the open hand's clearance that misalignment may take up
# how much wider than the object the hand must open before it descends, if it can [m]
OPEN_SLACK = 0.016
# the same, as a share of the open gripper's clearance around the object, if that is less
OPEN_SHARE = 0.6
PREFER_ZERO = 0.3  # weight of a grasp's own yaw, relative to its angle from the hand's yaw
WIDTH_AS_ANGLE = 20.0  # extra turn accepted for a grasp that is a metre narrower [rad/m]
FUNNEL_STEEP = 4.0  # `FUNNEL_SLOPE` if the object has neighbours
# a finger's thickness, half width, and distance at which a neighbour is clear [m]
FINGER = (0.014, 0.010, 0.016)
SHORT = 0.02  # missing room for a finger at which a grasp counts as fully crowded [m]
# gap to the fixed jaw as the hand comes down; how much less is tolerated [m]
BESIDE_JAW, NEARER = 0.008, 0.002
BY_JAW = 0.004  # `FUNNEL_RADIUS` of a hand with one moving jaw [m]
# opening beyond the object's width if a neighbour is in the way of the fully open hand [m]
NARROW = 0.024
CROWDED = 3.0  # extra turn accepted for a grasp whose fingers have room [rad]
MAX_TILT = 0.3  # tilt of the object off a face above which the hand waits over it [rad]
# bounds on the object's centre in the ee frame, x y z, once the fingers close [m]
CLOSING = (0.022, 0.015, 0.022)
LEAN = 0.5  # lean of a hand at full stretch [rad]
_QUARTER = math.pi / 2
_BOX, _SPHERE = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_SPHERE)


_MIDDLE = (0.0, 0.0, 0.0)

# A way to grasp an object: the yaw of a downward hand [rad], the object's width between the fingers
# and its length across them [m], and the vector from its centre to the middle between them, (3,)
# [m]. A plain tuple, since every label makes some.
Candidate = tuple[float, float, float, Sequence[float]]


class Lie(NamedTuple):
    """How an object lies, and the ways to grasp it.

    Attributes:
        grasps: The ways to grasp it.
        tall: The object's height [m].
        tilt: The angle to its nearest resting pose [rad].
        folds: The number of its yaws that look alike, 0 if all do.
        level: The slice of `grasps` in which the fingers meet upright sides.
        above: The height of its top over the middle between the fingers, by default half `tall`
            [m].
        fits: Whether the gripper can close around it, if that was checked.
    """

    grasps: Sequence[Candidate]
    tall: float
    tilt: float
    folds: int
    level: slice = slice(None)
    above: float | None = None
    fits: bool = True

    @property
    def yaw(self) -> float:
        """Yaw of the first grasp [rad]."""
        return self.grasps[0][0]


class Grasp(NamedTuple):
    """How to grasp an object, and how far the hand is from that grasp.

    Attributes:
        offset: The offset of the place to grasp from the middle between the holding pads, in frame
            `ee`, (3,) [m].
        width: The object's size between the fingers [m].
        length: The object's size across the fingers [m].
        half: The height of its top over the place to grasp [m].
        settled: Whether it rests on a face, leans on something without moving, or is between the
            fingers.
        yaw: The yaw of a downward hand that grasps it [rad].
        angle: The angle of the hand to that pose [rad].
        at: The position of `ee` that grasps it, (3,) [m].
        wide: The opening of the fingers on approach [m].
        open_enough: Whether the fingers pass on both sides of it.
        off: The misalignment of the hand, distance and angle as one length [m].
        height: The height over `at` that `off` requires, but at most what clears the object's top
            [m].
        funnel: The height over `at` that `off` requires [m].
        lean: How much the hand leans to reach it, 0 to 1.
    """

    offset: Sequence[float]
    width: float
    length: float
    half: float
    settled: bool
    yaw: float
    angle: float
    at: Sequence[float]
    wide: float
    open_enough: bool
    off: float
    height: float
    funnel: float
    lean: float


def is_cube(world: World, name: str) -> bool:
    """Return whether an object is a box with equal edges."""
    return world.kind(name) == _BOX and len(set(world.extents(name))) == 1


def once_per_state[F: Callable[..., Any]](compute: F) -> F:
    """Return a function whose results are cached until the world changes.

    Args:
        compute: A function of a world and of names in it.
    """

    @wraps(compute)
    def read(world: World, *names: str) -> Any:
        return world.remember((compute, names), lambda: compute(world, *names))

    return cast(F, read)


@once_per_state
def lie_of(world: World, name: str) -> Lie:
    """Return the ways to grasp an object as it lies."""
    rotation, hull = world.pose(name).rotation, world.hull(name)
    if hull is not None:
        return _hull_lie(hull, rotation)
    kind, extents = world.kind(name), world.extents(name)
    if kind == _BOX:
        return _box_lie(rotation, extents)
    width, _, length = extents
    ahead, left, up = rotation[:, 2].tolist()
    if kind == _SPHERE or abs(up) > math.sqrt(0.5):
        tilt = 0.0 if kind == _SPHERE else math.acos(min(1.0, abs(up)))
        return Lie([(0.0, width, width, _MIDDLE)], length, tilt, 0)
    grasps = _half_turns(math.atan2(left, ahead), (width, length), _MIDDLE)
    return Lie(grasps, width, math.asin(abs(up)), 2)


@once_per_state
def grasp_of(world: World, name: str) -> Grasp:
    """Return the best grasp of an object from the hand's present pose."""
    ee, gripper = world.ee, world.gripper
    lie, neighbours = lie_of(world, name), world.neighbours(name)
    yaw, width, length, centre = _nearest(world, world.at(name), lie, neighbours)
    x, y, z = (world.at(name) + centre).tolist()
    ee_x, ee_y, ee_z = ee.position.tolist()
    offset = [
        a * (x - ee_x) + b * (y - ee_y) + c * (z - ee_z) for a, b, c in ee.rotation.T.tolist()
    ]
    offset[1] -= gripper.middle(width)
    lean = 0.0 if world.robot.leans else world.reach.lean((x, y, z))
    angle, may_lean = world.off_down(yaw), min(angle_off_vertical(ee.rotation), lean * LEAN)
    angle = math.sqrt(max(0.0, angle * angle - may_lean * may_lean))
    half = lie.tall / 2 if lie.above is None else lie.above
    # offset of the object for one moving jaw [m]
    aside = gripper.middle(width + 2 * BESIDE_JAW)
    at_x, at_y = x - aside * math.sin(yaw), y + aside * math.cos(yaw)
    way, radius = (at_x - ee_x, at_y - ee_y), FUNNEL_RADIUS
    crowding = _crowding(yaw, gripper.most, neighbours)
    if gripper.lopsided:
        way, radius = _beside_jaw(*way, yaw, around=ee_z - z < half), BY_JAW
        crowding = 1.0
    room = max(0.0, gripper.most - width)  # clearance of the open gripper [m]
    free = min(ANGLE_FREE, TIGHT * room / width)
    off = math.hypot(*way) + ANGLE_AS_LENGTH * max(0.0, angle - free)
    slope = FUNNEL_STEEP if neighbours else FUNNEL_SLOPE
    funnel = slope * max(0.0, off - min(radius, TIGHT * room))
    return Grasp(
        offset=offset,
        width=width,
        length=length,
        half=half,
        settled=lie.tilt < MAX_TILT or is_inside(offset, CLOSING) or world.at_rest(name),
        yaw=yaw,
        angle=angle,
        at=(at_x, at_y, max(z, world.robot.ee.lowest, z + half - DEEPEST)),
        wide=gripper.most - max(0.0, room - NARROW) * crowding,
        open_enough=world.opening >= width + min(OPEN_SLACK, OPEN_SHARE * room),
        off=off,
        height=min(half + HOVER, funnel),
        funnel=funnel,
        lean=lean,
    )


def _beside_jaw(x: float, y: float, yaw: float, around: bool) -> tuple[float, float]:
    """Distances left to an object, across and along the motion of the one moving jaw, less what is
    tolerated [m].

    around: the jaws are on both sides of it, so that it may touch the fixed one.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    across, along = c * x + s * y, s * x - c * y
    nearer, farther = (BESIDE_JAW if around else NEARER), BESIDE_JAW
    return across, max(along - farther, 0.0) + min(along + nearer, 0.0)


def _nearest(
    world: World, position: F64, lie: Lie, neighbours: Sequence[tuple[float, float]]
) -> Candidate:
    """The grasp whose yaw is nearest to the hand's, with a small preference for zero yaw and narrow
    grasps.

    It depends on the hand so that a learner does not stop between two grasps, where it averages
    their labels: any turn makes one of them the nearer. position: the object's (3,) [m].
    neighbours: offsets (x, y) [m] of what stands around the object; grasps that they obstruct come
    last.
    """
    grasps, at = lie.grasps[lie.level], world.hand_yaw
    ahead, widest = world.ahead(position), world.gripper.most - LEAST_ROOM
    if world.robot.leans:
        at = world.turned(position)
        grasps = [
            (turn, width, length, centre)
            for yaw, width, length, centre in grasps
            for turn in (world.turns(yaw, math.pi, position) if lie.folds else (0.0,))
        ]
    narrowest = min([width for _, width, _, _ in grasps])

    def cost(grasp: Candidate) -> tuple[bool, float, float]:
        yaw, width, _, _ = grasp
        turn = abs(yaw - at) + PREFER_ZERO * abs(yaw) + WIDTH_AS_ANGLE * (width - narrowest)
        too_wide = width > widest and width > narrowest
        return too_wide, turn + CROWDED * _crowding(yaw + ahead, widest, neighbours), yaw

    yaw, width, length, centre = min(grasps, key=cost)
    return yaw + ahead, width, length, centre


def _crowding(yaw: float, widest: float, neighbours: Sequence[tuple[float, float]]) -> float:
    """Return how much the open fingers of a grasp would hit a neighbour of the object, 0 to 1."""
    thick, half, clear = FINGER
    c = math.cos(yaw)
    s = math.sin(yaw)
    worst = 0.0
    for x, y in neighbours:
        along, across = abs(s * x - c * y), abs(c * x + s * y)  # relative to the fingers' motion
        lack = share((widest / 2 + thick - along) / SHORT)
        worst = max(worst, lack * share((clear - across) / (clear - half)))
    return worst


def _half_turns(yaw: float, size: tuple[float, float], centre: Sequence[float]) -> list[Candidate]:
    """A grasp at the yaw nearest to 0, and half a turn to either side of it."""
    yaw -= math.pi * round(yaw / math.pi)
    return [(yaw + turn, *size, centre) for turn in (0.0, -math.pi, math.pi)]


def _hull_lie(hull: Hull, rotation: F64) -> Lie:
    """The lie of a mesh, on the nearest side of its hull on which it can rest."""
    cosines = hull.downs.dot(-rotation[2])
    nearest = int(cosines.argmax())
    rest, tilt = hull.rest(nearest), math.acos(min(1.0, float(cosines[nearest])))
    grasps: list[Candidate] = []
    acrosses, centres = rest.across.dot(rotation.T).tolist(), rest.centre.dot(rotation.T).tolist()
    for (ahead, left, _), size, centre in zip(acrosses, rest.sizes, centres, strict=True):
        yaw = math.atan2(left, ahead) + _QUARTER
        grasps += [(0.0, *size, centre)] if rest.round else _half_turns(yaw, size, centre)
    folds = 0 if rest.round else 2
    return Lie(grasps, rest.tall, tilt, folds, above=rest.above, fits=rest.fits)


def _box_lie(rotation: F64, extents: Sequence[float]) -> Lie:
    """The lie of a box on its nearest face.

    Its yaw is that of the side nearest to x or y, modulo a quarter turn.
    """
    ahead, left, vertical = rotation.tolist()
    heights = [abs(height) for height in vertical]
    up = heights.index(max(heights))
    side, other = (up + 1) % 3, (up + 2) % 3
    yaw = math.atan2(left[side], ahead[side])
    quarters = round(yaw / _QUARTER)
    yaw -= _QUARTER * quarters
    length, width = extents[side], extents[other]
    if quarters % 2:
        length, width = width, length
    grasps = (
        (yaw, width, length, _MIDDLE),
        (yaw - _QUARTER, length, width, _MIDDLE),
        (yaw + _QUARTER, length, width, _MIDDLE),
    )
    folds = 4 if length == width else 2
    tilt = math.acos(min(1.0, heights[up]))
    level = slice(None)
    if tilt >= MAX_TILT:  # it stands on an edge: the fingers meet the two sides that are upright
        level = (
            slice(0, 1) if (heights[side] > heights[other]) != bool(quarters % 2) else slice(1, 3)
        )
    return Lie(grasps, extents[up], tilt, folds, level)


def share(number: float) -> float:
    """Return a number clipped to 0 to 1."""
    return min(1.0, max(0.0, number))


def is_inside(offset: Sequence[float] | F64, box: tuple[float, float, float]) -> bool:
    """Return whether an offset (3,) [m] is within a box's half lengths (3,) [m]."""
    return abs(offset[0]) <= box[0] and abs(offset[1]) <= box[1] and abs(offset[2]) <= box[2]
