"""What an episode's condition can vary: one table of bounds, draws, and places in a state's variation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from manip_il.mdp import I64
from manip_il.sim.config import CAMERAS

Range = tuple[float, float]
_SEEDS = 2**31  # number of clutter seeds; a state stores each exactly, as a float
OWN = -1.0  # nothing is drawn: objects keep their own shape or colour


def _number(rng: np.random.Generator, range_: Range) -> float:
    return float(rng.uniform(*range_))


def _whole(rng: np.random.Generator, range_: Range) -> int:
    low, high = range_
    return int(rng.integers(int(low), int(high), endpoint=True))


def _whole_and_seed(rng: np.random.Generator, range_: Range) -> list[int]:
    return [_whole(rng, range_), int(rng.integers(_SEEDS))]


def _colour(rng: np.random.Generator, range_: Range) -> list[float]:
    return rng.uniform(*range_, 3).tolist()


def _vectors(rng: np.random.Generator, range_: Range) -> dict[str, list[float]]:
    """A vector (3,) per camera, of random length in a uniformly random direction."""
    found = {}
    for camera in CAMERAS:
        direction = rng.normal(size=3)
        found[camera] = (rng.uniform(*range_) * direction / np.linalg.norm(direction)).tolist()
    return found


class Quantity(NamedTuple):
    """A quantity that a condition can vary.

    Args:
        bounds: Limits of its range.
        changes: `model` for the physics, `look` and `pictures` for what only cameras show, `sensing` for noise in
            observations; empty for the rest.
        of_object: Whether it has no effect in a task without an object.
        draw: How an episode's value is drawn from the range.
        places: Where its numbers are in the world's part of a variation, camera after camera in the order of `CAMERAS`.
        nominal: Each of these numbers if nothing is drawn.
    """

    bounds: Range
    changes: str = ""
    of_object: bool = False
    draw: Callable[[np.random.Generator, Range], Any] = _number
    places: Sequence[int] | I64 = range(0)
    nominal: float = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether the ends of its range are whole numbers."""
        return self.draw in (_whole, _whole_and_seed)


# Place 0 of the world's part of a variation is the shape's. The camera at the side got its places after the others.
RANGES = {
    "action_noise": Quantity((0, 1)),
    "random_actions": Quantity((0, 1)),
    "knock": Quantity((0, 0.3), of_object=True),
    "knock_step": Quantity((0, 10_000), draw=_whole),
    "joint_noise": Quantity((0, 1), "sensing"),
    "position_noise": Quantity((0, 1), "sensing", of_object=True),
    "delay": Quantity((0, 100), draw=_whole),
    "mass": Quantity((0.001, 10), "model", of_object=True),
    "size": Quantity((0.01, 0.09), "model", of_object=True),
    "friction": Quantity((0.01, 10), "model", of_object=True),
    "joint_damping": Quantity((0.01, 100), "model", places=[1], nominal=1.0),
    "actuator_gain": Quantity((0.1, 10), "model", places=[2], nominal=1.0),
    "posture": Quantity((0, 0.5), places=[3]),
    "colour": Quantity((0, 1), "look", True, _colour, range(4, 7), OWN),
    "table": Quantity((0, 1), "look", False, _colour, range(7, 10), OWN),
    "camera_shift": Quantity((0, 1), "look", False, _vectors, np.r_[12:15, 24:27, 15:18]),
    "camera_turn": Quantity((0, 90), "look", False, _vectors, np.r_[18:21, 27:30, 21:24]),
    "brightness": Quantity((0.1, 3), "look", places=[10], nominal=1.0),
    "light_turn": Quantity((-180, 180), "look", places=[11]),
    "clutter": Quantity((0, 12), "look", False, _whole_and_seed, [30, 31]),
    "picture_delay": Quantity((0, 100), "pictures", draw=_whole),
}
