"""Layouts and rewards of `carry`, as pure geometry.

A layout is what stands on the table, and a reward is what a metre of path costs there.

Paths are those of the carried object's centre. Features are densities per metre of path, functions
of a point alone; for a path of points, or an edge of the grid, they are integrated along it. A
reward has a weight for each feature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError, shorten
from manip_il.mdp import F64
from manip_il.option import NameOrPath

FEATURES = (
    "length",  # 1
    "height",  # height of the object over its resting height, in tenths of a metre
    "above_vase",  # 1 over it, 0.4 at 2 cm beside it
    "above_laptop",
    "above_candle",
    "near_vase",  # 1 at it or over it, 0.6 at 8 cm beside it, 0.14 at 16 cm
    "near_laptop",
    "near_candle",
    "near_edge",  # 1 at the edge of the table or beyond it, 0.6 at 5 cm
)
MOST = 1e6  # largest weight


class Obstacle(NamedTuple):
    """Size of an obstacle for an arm whose workspace is 30 cm wide.

    Attributes:
        half: Half its lengths along x and y, (2,) [m].
        height: Its height [m].
    """

    half: tuple[float, float]
    height: float


OBSTACLES = {
    "vase": Obstacle((0.032, 0.032), 0.13),
    "laptop": Obstacle((0.065, 0.048), 0.03),
    "candle": Obstacle((0.016, 0.016), 0.11),
}
FULL = 0.15  # half width of a workspace in which obstacles have these sizes [m]
# clearance between an obstacle and what is carried past it, beside and over it [m]
ASIDE, ABOVE = 0.012, 0.012
HEIGHT = 0.1  # unit of the feature `height` [m]
OVER = 0.015  # standard deviation of the `above` features beside an obstacle [m]
NEAR = 0.08  # standard deviation of the `near` features of obstacles [m]
NEAR_EDGE = 0.05  # standard deviation of `near_edge` [m]
STEP = 0.005  # half the spacing of the points at which a line's room is checked [m]


class Edge(NamedTuple):
    """Edge of the table.

    Attributes:
        at: A point on it, (x, y) [m].
        outwards: The unit vector away from the table, (2,).
    """

    at: tuple[float, ...]
    outwards: tuple[float, ...]


class Part(NamedTuple):
    """Part of the object or the hand, relative to the object's centre.

    Attributes:
        bottom: The height of its lowest point [m].
        radius: Its radius about the vertical [m].
    """

    bottom: float
    radius: float


@dataclass(frozen=True)
class Layout:
    """What stands on the table in one episode.

    Attributes:
        scale: The factor on all lengths, 1 for a workspace of half width `FULL`.
        goal: The target of the object's centre, (3,) [m].
        places: The (x, y) [m] of the obstacles that are present, by name.
        edge: The table's edge; None if it is not near.
        half: Half the object's longest length [m].
        parts: The parts of the object and the hand, relative to the object's centre.
    """

    scale: float
    goal: tuple[float, ...]
    places: tuple[tuple[str, tuple[float, ...]], ...]
    edge: Edge | None
    half: float
    parts: tuple[Part, ...]

    @cached_property
    def boxes(self) -> tuple[tuple[str, F64, F64, float], ...]:
        """Name, middle (2,), half lengths (2,) and height of every obstacle present [m]."""
        return tuple(
            (
                name,
                np.array(place),
                self.scale * np.array(OBSTACLES[name].half),
                self.scale * OBSTACLES[name].height,
            )
            for name, place in self.places
        )

    def densities(self, points: F64) -> F64:
        """Return the features per metre of path at points (N, 3) [m], (N, K)."""
        found = np.zeros((len(points), len(FEATURES)))
        found[:, 0] = 1.0
        found[:, 1] = np.maximum(points[:, 2] - self.half, 0.0) / (self.scale * HEIGHT)
        for name, middle, half, _ in self.boxes:
            off = _beside(points, middle, half) / self.scale
            found[:, FEATURES.index(f"above_{name}")] = _bump(off, OVER)
            found[:, FEATURES.index(f"near_{name}")] = _bump(off, NEAR)
        if self.edge is not None:
            inside = np.maximum(
                (np.array(self.edge.at) - points[:, :2]) @ np.array(self.edge.outwards), 0.0
            )
            found[:, FEATURES.index("near_edge")] = _bump(inside / self.scale, NEAR_EDGE)
        return found

    def room(self, points: F64) -> F64:
        """Return the clearance to spare for an object carried at points (N, 3), (N,) [m].

        If it is negative, object or hand is nearer to an obstacle than `ASIDE` or `ABOVE`.
        """
        found = np.full(len(points), np.inf)
        bottoms, radii = np.array(self.parts).T
        for _, middle, half, height in self.boxes:
            over = points[:, 2, None] + (bottoms - (height + ABOVE))
            beside = _beside(points, middle, half)[:, None] - (radii + ASIDE)
            np.minimum(found, np.maximum(beside, over).min(axis=1), out=found)
        return found

    def is_free(self, start: F64, end: F64, spare: float) -> bool:
        """Return whether an object may be carried along a straight line.

        The clearance is checked at points that are at most 2 `STEP` apart.

        Args:
            start: The line's first point, (3,) [m].
            end: The line's last point, (3,) [m].
            spare: The least `room` that is required along the line [m].
        """
        pieces = max(1, math.ceil(np.linalg.norm(end - start) / (2 * STEP)))
        return bool(
            self.room(start + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (end - start)).min()
            >= spare
        )


def _beside(points: F64, middle: F64, half: F64) -> F64:
    """Return how far points (N, 3) are from a box along x and y, 0 over it, (N,) [m]."""
    return np.hypot(*np.maximum(np.abs(points[:, :2] - middle) - half, 0.0).T)


def _bump(off: F64, width: float) -> F64:
    return np.exp(-0.5 * np.square(off / width))


@dataclass(frozen=True)
class Reward:
    """Weights of the features, each the cost of a metre of path on which its feature is 1.

    Attributes:
        weights: The weights, (K,), in the order of `FEATURES`.

    Raises:
        UsageError: If a weight is outside 0 to `MOST`, or that of `length` is 0, as paths could
            then have any length.
    """

    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, weight in zip(FEATURES, self.weights, strict=True):
            if not 0 <= weight <= MOST or (name == "length" and not weight):
                raise UsageError(
                    f"weight of {name} is {weight:g}; expected 0 to {MOST:g}, and more than 0 for"
                    " length, as paths could otherwise have any length"
                )

    @classmethod
    def parse(cls, text: NameOrPath) -> Reward:
        """Return the reward that a text or a file describes; weights are 0 by default.

        Args:
            text: The name of a shipped reward, or `NAME=NUMBER,...`; or the `Path` of a
                `reward.json`, whose lists `names` and `weights` are read.

        Raises:
            UnknownName: If a feature is unknown.
            UsageError: If the text or the file cannot be read, or a weight is invalid.
        """
        if (shipped := TASTES.get(str(text))) is not None:
            return shipped
        try:
            if isinstance(text, Path):
                tree = checks.read_json(text, "a reward: names and weights")
                pairs = list(zip(tree["names"], tree["weights"], strict=True))
            else:
                pairs = [word.split("=") for word in text.split(",")]
            weights = {str(name).strip(): float(weight) for name, weight in pairs}
        except (ManipError, LookupError, TypeError, ValueError) as error:
            expected = (
                f"{', '.join(TASTES)}, reward.json with names and weights, or NAME=NUMBER,..."
            )
            raise UsageError(
                f"reward is {shorten(str(text))}: {checks.one_line(error)}; expected {expected}"
            ) from None
        if unknown := [name for name in weights if name not in FEATURES]:
            raise UnknownName("feature", unknown[0], FEATURES)
        return cls(tuple(weights.get(name, 0.0) for name in FEATURES))

    @property
    def numbers(self) -> str:
        """The nonzero weights as `NAME=NUMBER,...`, not rounded."""
        pairs = zip(FEATURES, self.weights, strict=True)
        return ",".join(
            f"{name}={repr(weight).removesuffix('.0')}" for name, weight in pairs if weight
        )


TASTES: dict[str, Reward] = {
    "careful": Reward((1.0, 1.0, 8.0, 6.0, 12.0, 4.0, 2.0, 6.0, 4.0)),
    "low": Reward((1.0, 6.0, 4.0, 1.0, 4.0, 1.0, 0.5, 1.0, 1.0)),
    "hasty": Reward((1.0, 0.2, 0.5, 0.0, 1.0, 0.2, 0.0, 0.5, 0.2)),
}
DEFAULT = "careful"
