"""How an object of any shape rests on the table, and where a downward hand can grasp it.

Everything is computed from the object's convex hull, in the object's own frame, once per process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from manip_il.mdp import F64
from manip_il.sim.shape import ROLLING_MESH

DEEPEST = 0.035  # depth of the ee site below an object's top at which the palm just clears it [m]
LEAST_HEIGHT = 0.012  # least height of an object on the table: fingers slip over lower ones [m]
LEAST_ROOM = 0.002  # least clearance of an open gripper around an object [m]
_DIRECTIONS = 500  # of a hull with more points, only the outermost in this many directions are kept
# angles between sides that count as one, and between faces of one side [rad]
_ALIKE, _COPLANAR = 0.2, 0.01
_FINGER = 0.012  # half a finger's width plus its sideways error [m]
_STRIP = np.array([[-_FINGER], [_FINGER]])
_LEVEL = 0.004  # spacing of the heights at which widths are measured [m]
_TIP = 0.001  # height of the lowest of those levels over the fingertips [m]
_APART = math.radians(25)  # least angle between two grasps [rad]
# slope of the sides at the fingertips above which the object is grasped as low as possible
_SLOPE = 0.1
# grasps whose slope at the fingertips exceeds the smallest by more than this are dropped
_STEEP = 0.2
_WIDER = 0.02  # grasps wider than the narrowest by more than this are dropped [m]
_ROUND = 0.03  # largest variation of a round object's width, as a share of it


class Rest(NamedTuple):
    """A side on which an object rests, and the w grasps of an object that rests on it.

    Attributes:
        down: Unit vector in the object's frame that points down when the object rests on the side,
            (3,).
        height: Height of the body's origin over the table [m].
        tall: Height of the object [m].
        above: Height of the object's top over the grasp [m].
        across: Unit vector along the fingers' motion for each grasp, in the object's frame, (w, 3).
        centre: Middle between the fingers for each grasp, in the object's frame, (w, 3) [m].
        sizes: For each grasp, the object's width between the fingers and its length at right angles
            to that [m].
        fits: Whether the object is narrow enough for the open fingers, and tall enough to grip.
        round: Whether any yaw will do.
    """

    down: F64
    height: float
    tall: float
    above: float
    across: F64
    centre: F64
    sizes: tuple[tuple[float, float], ...]
    fits: bool
    round: bool


class Hull:
    """An object's convex hull, and the sides on which it rests, for one gripper.

    Attributes:
        extents: Lengths of the box around it, centred on the body's origin, (3,) [m].
        downs: For each side, the unit vector that points down when the object rests on it, (n, 3);
            the first is the nearest to down as the object was modelled.
    """

    def __init__(self, model: mujoco.MjModel, body: int, geom: int, lowest: float, widest: float):
        """Compute the hull of a body's mesh.

        Args:
            model: The compiled model.
            body: Id of the body.
            geom: Id of its geom with the mesh.
            lowest: Least height of `ee` over the table [m].
            widest: Opening of the open gripper [m].
        """
        points = _few(_vertices(model, geom))
        self._hull = ConvexHull(points)
        self._centre = model.body_ipos[body].copy()
        self._gripper = (lowest, widest)
        self._rests: dict[int, Rest] = {}
        self.downs = _resting(self._hull, self._centre)
        self.extents = tuple[float, ...]((2 * np.abs(points).max(axis=0)).tolist())

    def rest(self, number: int) -> Rest:
        """Return how the object rests on the side `downs[number]`, computed on first use."""
        if number not in self._rests:
            self._rests[number] = _rest(
                self._hull, self._centre, self.downs[number], *self._gripper
            )
        return self._rests[number]


def _vertices(model: mujoco.MjModel, geom: int) -> F64:
    """Vertices of a geom's mesh in its body's frame, (n, 3) [m]."""
    mesh, rotation = int(model.geom_dataid[geom]), np.empty(9)
    start = model.mesh_vertadr[mesh]
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]].astype(np.float64)
    return vertices @ rotation.reshape(3, 3).T + model.geom_pos[geom]


def _few(points: F64) -> F64:
    """The outermost points in many directions, if there are more points than directions."""
    if len(points) <= _DIRECTIONS:
        return points
    number = np.arange(_DIRECTIONS) + 0.5
    # Fibonacci sphere
    z, turn = 1 - 2 * number / _DIRECTIONS, number * math.pi * (1 + math.sqrt(5))
    ways = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    return points[np.unique((points @ ways).argmax(axis=0))]


def _resting(hull: ConvexHull, centre: F64) -> F64:
    """Outward normals (n, 3) of the stable sides: the one facing most downwards, then the most
    stable first.

    A side is stable if the centre of mass is over it or, owing to rolling friction, nearly so.
    """
    normals = hull.equations[:, :3]
    heights = -(hull.equations[:, 3] + normals @ centre)
    cosines = normals @ normals.T
    apart = cosines < math.cos(_COPLANAR)
    sines = np.sqrt(np.maximum(1 - cosines**2, 1e-12))
    # to the side's edges
    room = np.where(apart, (heights - cosines * heights[:, None]) / sines, np.inf).min(axis=1)
    stable = np.flatnonzero((room > 0) | (heights == heights.min()))
    order = np.argsort(-room / heights, kind="stable")
    downs = [normals[stable[np.argmin(normals[stable, 2])]]]
    for down in normals[order[room[order] > -ROLLING_MESH]]:
        if max(down @ one for one in downs) < math.cos(_ALIKE):
            downs.append(down)
    return np.array(downs)


def _rest(hull: ConvexHull, centre: F64, down: F64, lowest: float, widest: float) -> Rest:
    first = np.cross(down, np.eye(3)[np.abs(down).argmin()])
    first /= np.linalg.norm(first)
    axes = np.array([first, np.cross(-down, first)])  # horizontal
    heights = -(hull.points - centre) @ down
    height, tall = float(-heights.min()), float(np.ptp(heights))
    flat, turns = (hull.points - centre) @ axes.T, _turns(hull, axes)
    deepest = max(lowest, tall - DEEPEST)
    for at in (max(deepest, min(height, tall / 2)), deepest):  # heights of the hand over the table
        levels = np.arange(at - lowest + _TIP, (heights + height).max() - _TIP / 2, _LEVEL)
        cuts = [_cut(hull, heights + height, flat, level) for level in levels.tolist()]
        ways, any_yaw = _ways([_way(cuts, turn) for turn in turns], widest - LEAST_ROOM)
        if min(way.slope for way in ways) <= _SLOPE:  # else it narrows upwards: grasp lower
            break
    turned = np.array([[math.cos(way.turn), math.sin(way.turn)] for way in ways])
    across = turned @ axes
    middle = (
        centre + (at - height) * -down + np.array([way.middle for way in ways])[:, None] * across
    )
    return Rest(
        down=down,
        height=float((hull.points @ down).max()),
        tall=tall,
        above=max(tall - at, _LEVEL),
        across=across,
        centre=middle,
        sizes=tuple((way.width, way.length) for way in ways),
        fits=min(way.width for way in ways) <= widest - LEAST_ROOM and tall >= LEAST_HEIGHT,
        round=any_yaw,
    )


def _cut(hull: ConvexHull, heights: F64, flat: F64, level: float) -> F64:
    """Segments (n, 2, 2) [m] of the outline at a height."""
    z, xy = heights[hull.simplices], flat[hull.simplices]
    after_z, after_xy = np.roll(z, -1, axis=1), np.roll(xy, -1, axis=1)
    crossing = (z > level) != (after_z > level)  # true for two edges of a triangle, or for none
    share = (level - z[crossing]) / (after_z - z)[crossing]
    return (xy[crossing] + share[:, None] * (after_xy - xy)[crossing]).reshape(-1, 2, 2)


def _turns(hull: ConvexHull, axes: F64) -> F64:
    """Candidate directions of the fingers' motion [rad]: all around, and flush with upright
    sides if these are few.
    """
    sides = hull.equations[:, :3] @ axes.T
    upright = sides[np.hypot(*sides.T) > 0.7]
    flush = np.unique(np.degrees(np.arctan2(upright[:, 1], upright[:, 0])).round(1) % 180)
    around = np.arange(0, 180, 5.0)
    return np.radians(
        np.unique(np.concatenate([around, flush])) if len(flush) < len(around) else around
    )


class _Way(NamedTuple):
    """A grasp. turn: direction of the fingers' motion [rad].

    middle: offset along it from the centre of mass [m].
    """

    turn: float
    width: float
    length: float
    middle: float
    slope: float


def _ways(ways: Sequence[_Way], widest: float) -> tuple[list[_Way], bool]:
    """The locally narrowest grasps that fit, or the narrowest if none does.

    And whether any yaw will do.
    """
    narrowest = min(ways, key=lambda way: way.width)
    fitting = [way for way in ways if way.width <= min(widest, narrowest.width + _WIDER)]
    if max(way.width for way in ways) - narrowest.width < _ROUND * narrowest.width:
        return [narrowest], True
    if not fitting:
        return [narrowest], False
    shallowest, kept = min(fitting, key=lambda way: way.slope), list[_Way]()
    for way in sorted(fitting, key=lambda way: way.width):
        beside = (one.width for one in ways if _between(one.turn, way.turn) < _APART / 2)
        apart = all(_between(one.turn, way.turn) >= _APART for one in kept)
        is_least = way.width <= min(beside) + 1e-4
        if way.slope <= shallowest.slope + _STEEP and apart and is_least:
            kept.append(way)
    return kept or [shallowest], False


def _way(cuts: Sequence[F64], turn: float) -> _Way:
    c, s = math.cos(turn), math.sin(turn)
    ends, lengths = [], []
    for cut in cuts:
        along, across = cut @ (c, s), cut @ (-s, c)
        lengths.append((across.min(), across.max()))
        there = (across.min(axis=1) <= _FINGER) & (across.max(axis=1) >= -_FINGER)
        if there.any():
            (a, b), (p, q) = across[there].T, along[there].T
            shares = (_STRIP - a) / np.where(a == b, 1e-12, b - a)
            met = p + shares.clip(0, 1) * (q - p)
            ends.append((met.min(), met.max()))
    low, high = np.array(ends).T
    least, most = float(low.min()), float(high.max())
    up = min(2, len(ends) - 1)
    rises = (low[up] - low[0]) * (low[0] == least), (high[0] - high[up]) * (high[0] == most)
    slope = max(0.0, float(max(rises) / max(up * _LEVEL, _LEVEL)))
    return _Way(turn, most - least, float(np.ptp(lengths)), (most + least) / 2, slope)


def _between(one: float, other: float) -> float:
    """Angle between two lines [rad]."""
    return abs(math.remainder(one - other, math.pi))
