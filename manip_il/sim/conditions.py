"""Conditions: named ranges of what may differ from the nominal world.

An episode's seed alone decides its values.

`RANGES` is the one table of what can vary: bounds, draws, and places in a state's variation. The
drawn values are applied to the model by `variation.py`, to pictures by `view.py`, to what a policy
observes by `env.py`, and during the episode by `events.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import I64
from manip_il.option import NameOrPath
from manip_il.seeding import rng_for
from manip_il.sim.config import CAMERAS
from manip_il.sim.shape import KINDS, draws_shape

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
        changes: `model` for the physics, `look` and `pictures` for what only cameras show,
            `sensing` for noise in observations; empty for the rest.
        of_object: Whether it has no effect in a task without an object.
        draw: How an episode's value is drawn from the range.
        places: Where its numbers are in the world's part of a variation, camera after camera in the
            order of `CAMERAS`.
        nominal: Each of these numbers if nothing is drawn.
    """

    bounds: Range
    changes: str = ""
    of_object: bool = False
    draw: Callable[[np.random.Generator, Range], Any] = _number
    places: Sequence[int] | I64 = range(0)
    nominal: float = 0.0


# Place 0 of the world's part of a variation is the shape's. The camera at the side got its places
# after the others.
RANGES = {
    "action_noise": Quantity((0, 1)),
    "random_actions": Quantity((0, 1)),
    "knock": Quantity((0, 0.3), of_object=True),
    "knock_step": Quantity((0, 10_000), of_object=True, draw=_whole),
    "joint_noise": Quantity((0, 1), "sensing"),
    "position_noise": Quantity((0, 1), "sensing", of_object=True),
    "delay": Quantity((0, 100), draw=_whole),
    "mass": Quantity((0.001, 10), "model", of_object=True),
    "size": Quantity((0.01, 0.09), "model", of_object=True),
    "friction": Quantity((0.01, 10), "model", of_object=True),
    "joint_damping": Quantity((0.01, 100), "model", places=[1], nominal=1.0),
    "actuator_gain": Quantity((0.1, 10), "model", places=[2], nominal=1.0),
    "servo": Quantity((0, 1)),
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


_KNOCK_STEP = (5, 24)  # default for a condition with a knock


@dataclass(frozen=True, init=False)
class Condition:
    """Ranges of the quantities that differ from the nominal world; all others are nominal.

    Each range is (low, high), both ends included, or a single number.

    Args:
        name: The condition's name, which must be usable as a file name.
        action_noise: Standard deviation of Gaussian noise on every executed action, as a share of
            its full range.
        random_actions: Share of control steps at which a random action is executed, each joint
            within its longest step.
        knock: Distance by which the object is moved once [m].
        knock_step: Control step at which it is moved, by default 5 to 24.
        joint_noise: Standard deviation of Gaussian noise on the joints in a policy's
            observations [rad].
        position_noise: The same for the object's position [m].
        delay: Control steps by which observations are late.
        mass: Mass of the object [kg].
        size: Edge or width of the object [m].
        friction: Sliding friction of the object.
        joint_damping: Factor on the damping of every arm joint.
        actuator_gain: Factor on kp of the arm's actuators; its square root is that on kv.
        servo: Share of the ranges in the robot's YAML from which its servos are drawn.
        posture: Largest offset of every joint from home at the start [rad].
        colour: Red, green and blue of the object, each from the range.
        table: The same for the table.
        camera_shift: Shift of every camera, in a random direction [m].
        camera_turn: Rotation of every camera, about a random axis [deg].
        brightness: Factor on every lamp.
        light_turn: Rotation of the lamps about the vertical [deg].
        clutter: Number of visual objects around the workspace.
        picture_delay: Control steps by which only pictures are late.

    Raises:
        UnknownName: If there is no quantity of a range's name.
        UsageError: If a range is empty or out of bounds.
        ManipError: If the name cannot be a file name.
    """

    name: str
    ranges: Mapping[str, Range] = field(hash=False)

    def __init__(self, name: str = "nominal", **ranges: Any):
        checks.name("a condition's name", name)
        if "knock" in ranges:
            ranges = {"knock_step": _KNOCK_STEP} | ranges
        elif "knock_step" in ranges:
            raise UsageError(f"condition {name!r} has a knock_step but no knock; give both")
        ranges = {one: _range(name, one, range_) for one, range_ in ranges.items()}
        kept = {one: ranges[one] for one in RANGES if one in ranges}
        vars(self).update(name=name, ranges=kept)  # frozen from here on

    def for_world(
        self,
        *,
        has_object: bool,
        sees: bool,
        sizes: Range | None,
        named: bool = False,
        servos: bool = False,
    ) -> Condition | None:
        """Return the condition without the ranges that have no effect.

        Args:
            has_object: Whether the task has an object.
            sees: Whether the policy has cameras.
            sizes: Object sizes that the task can take [m]; None: only its own.
            named: Whether the task's texts tell objects by their colours, which then stay.
            servos: Whether the robot has servos, which then replace actuators' gain and damping.

        Returns:
            The condition; None if it had ranges and none of them is left.

        Raises:
            UsageError: If the task can take none of the condition's sizes.
        """
        kept = {
            name: range_
            for name, range_ in self.ranges.items()
            if (has_object or not RANGES[name].of_object)
            and (sees or RANGES[name].changes not in ("look", "pictures"))
            and (sizes or name != "size")
            and not (named and name == "colour")
            and name not in (("joint_damping", "actuator_gain") if servos else ("servo",))
        }
        if "size" in kept and sizes is not None:
            (least, most), asked = sizes, kept["size"]
            low, high = kept["size"] = max(asked[0], least), min(asked[1], most)
            if low > high:
                raise UsageError(
                    f"{self.name}: size is {words(asked)} m, and the task takes objects of"
                    f" {least:.3g} to {most:.3g} m; choose other sizes"
                )
        if self.ranges and not kept:
            return None
        return Condition(self.name, **kept)

    def only(self, changes: str) -> Condition:
        """Return the condition with only the ranges that change one thing.

        Args:
            changes: What they change, as in `Quantity.changes`.
        """
        kept = {
            name: range_ for name, range_ in self.ranges.items() if RANGES[name].changes == changes
        }
        return Condition(self.name, **kept)

    def draw(self, seed: int) -> dict[str, Any]:
        """Return the values drawn for an episode, by the names of the ranges and in their units.

        Each value has a random stream of its own, so that adding a range leaves the other values
        unchanged. camera_shift and camera_turn have one vector (3,) per camera, in the camera's own
        frame.

        Args:
            seed: Seed of the episode.
        """
        return {
            name: RANGES[name].draw(rng_for(seed, f"condition {name}"), range_)
            for name, range_ in self.ranges.items()
        }

    def to_json(self) -> dict[str, Any]:
        """Return name and ranges as plain JSON values."""
        return {"name": self.name} | {name: list(range_) for name, range_ in self.ranges.items()}

    def __str__(self) -> str:
        said = ", ".join(f"{name} {words(range_)}" for name, range_ in self.ranges.items())
        return f"{self.name} ({said})" if said else self.name


def merged(conditions: Sequence[Condition]) -> Condition:
    """Return one condition with the ranges of all, named after all.

    Later ranges override earlier ones.
    """
    ranges = {name: range_ for condition in conditions for name, range_ in condition.ranges.items()}
    return Condition(
        "_".join(condition.name for condition in conditions)[: checks.LONGEST_NAME], **ranges
    )


def turn_of(conditions: Sequence[Condition], seed: int) -> Condition:
    """Return the condition of a seed's episode: conditions take turns.

    If there are none, it is nominal.
    """
    return conditions[seed % len(conditions)] if conditions else NOMINAL


def draw(conditions: Sequence[Condition], seed: int, shape: NameOrPath = "") -> dict[str, Any]:
    """Return the values drawn for the episode of a seed, by name.

    Args:
        conditions: Conditions that take turns by seed, as in `turn_of`.
        seed: Seed of the episode.
        shape: The object, as in `EnvConfig.object`; if it is `any`, one of `KINDS` is drawn, too.
    """
    drawn = turn_of(conditions, seed).draw(seed)
    if not draws_shape(shape):
        return drawn
    return {"shape": KINDS[int(rng_for(seed, "condition shape").integers(len(KINDS)))]} | drawn


def words(range_: Range) -> str:
    """Return a range as people read it: `0.03 to 0.07`."""
    low, high = range_
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _range(condition: str, name: str, given: Any) -> Range:
    """A range as a tuple, from what Python or YAML gives: a pair or a number."""
    if name not in RANGES:
        raise UnknownName(f"key in {condition}:", name[: checks.LONGEST_NAME], RANGES)
    least, most = RANGES[name].bounds
    is_whole = RANGES[name].draw in (_whole, _whole_and_seed)
    try:
        low, high = given if isinstance(given, list | tuple) else (given, given)
        low = checks.number(name, low, least, most)
        high = checks.number(name, high, low, most)
        if is_whole and (low % 1 or high % 1):
            raise ValueError(given)
    except (ManipError, ValueError):
        raise UsageError(
            f"{condition}: {name} is {checks.shorten(given)}; expected a{' whole' * is_whole}"
            f" number, or [low, high], from {least} to {most}"
        ) from None
    return given if isinstance(given, tuple) else (low, high)


NOMINAL = Condition()
