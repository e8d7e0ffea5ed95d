"""Conditions: named ranges of what may differ from the nominal world; an episode's seed alone decides its values.

The drawn values are applied to the model by `variation.py`, to pictures by `view.py`, to what a policy observes by
`env.py`, and during the episode by `events.py`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.option import NameOrPath
from manip_il.seeding import rng_for
from manip_il.sim.config import CAMERAS
from manip_il.sim.shape import KINDS, draws_shape

Range = tuple[float, float]
# Limits of each range.
_BOUNDS: dict[str, Range] = {
    "action_noise": (0, 1),
    "random_actions": (0, 1),
    "knock": (0, 0.3),
    "knock_step": (0, 10_000),
    "joint_noise": (0, 1),
    "position_noise": (0, 1),
    "delay": (0, 100),
    "mass": (0.001, 10),
    "size": (0.01, 0.09),
    "friction": (0.01, 10),
    "joint_damping": (0.01, 100),
    "actuator_gain": (0.1, 10),
    "posture": (0, 0.5),
    "colour": (0, 1),
    "table": (0, 1),
    "camera_shift": (0, 1),
    "camera_turn": (0, 90),
    "brightness": (0.1, 3),
    "light_turn": (-180, 180),
    "clutter": (0, 12),
    "picture_delay": (0, 100),
}
_WHOLE = ("knock_step", "delay", "picture_delay", "clutter")
_SEEDS = 2**31  # number of clutter seeds; a state stores each exactly, as a float
_KNOCK_STEP = (5, 24)  # default for a condition with a knock
_BODY = ("mass", "size", "friction")  # the object's physics
_MODEL = (*_BODY, "joint_damping", "actuator_gain")
_OBJECT = ("knock", "colour", "position_noise", *_BODY)
PICTURED = ("colour", "table", "camera_shift", "camera_turn", "brightness", "light_turn", "clutter")  # only in pictures
_SEEN = (*PICTURED, "picture_delay")
MEASURED = ("joint_noise", "position_noise")


@dataclass(frozen=True, init=False)
class Condition:
    """Ranges (low, high), both ends included, or single numbers, for the quantities below; all others are nominal.

    action_noise: standard deviation of Gaussian noise on every executed action, as a share of its full range.
    random_actions: share of control steps at which a random action is executed, each joint within its longest step.
    knock: distance by which the object is moved once [m], at a control step from knock_step, by default 5 to 24.
    joint_noise [rad], position_noise [m]: standard deviations of Gaussian noise on the joints and the object's position
    in a policy's observations. delay: control steps by which observations are late. mass [kg], size (edge or width [m])
    and sliding friction of the object. colour: red, green and blue of the object, each from the range; table: the same
    for the table. joint_damping: factor on the damping of every arm joint; actuator_gain: factor on kp of the arm's
    actuators, and its square root on kv. posture: largest offset of every joint from home at the start [rad].
    camera_shift [m], camera_turn [deg]: shift and rotation of every camera, in a random direction. brightness: factor
    on every lamp; light_turn: rotation of the lamps about the vertical [deg]. clutter: number of visual objects around
    the workspace. picture_delay: control steps by which only pictures are late.

    Raises `UnknownName` for an unknown range, `UsageError` for a range that is empty or out of bounds, `ManipError` for
    a name that cannot be a file name.
    """

    name: str
    ranges: Mapping[str, Range] = field(hash=False)

    def __init__(self, name: str = "nominal", **ranges: Any):
        checks.name("a condition's name", name)
        if "knock" in ranges:
            ranges = {"knock_step": _KNOCK_STEP} | ranges
        ranges = {one: _range(name, one, range_) for one, range_ in ranges.items()}
        kept = {one: ranges[one] for one in _BOUNDS if one in ranges and (one != "knock_step" or "knock" in ranges)}
        vars(self).update(name=name, ranges=kept)  # frozen from here on

    def for_world(self, *, has_object: bool, sees: bool, sizes: Range | None) -> Condition | None:
        """Return the condition without the ranges that have no effect; None if it had some and none is left.

        has_object: whether the task has an object. sees: whether the policy has cameras. sizes: object sizes that the
        task can take [m]; None: only its own.
        Raises `UsageError` if none of the condition's sizes is among them.
        """
        dropped = {*(() if has_object else _OBJECT), *(() if sees else _SEEN), *(() if sizes else ("size",))}
        kept = {name: range_ for name, range_ in self.ranges.items() if name not in dropped}
        if "size" in kept and sizes is not None:
            kept["size"] = _overlap(self.name, kept["size"], sizes)
        if self.ranges and not kept.keys() - {"knock_step"}:
            return None
        return Condition(self.name, **kept)

    def only(self, names: Collection[str]) -> Condition:
        """Return the condition with only the named ranges."""
        return Condition(self.name, **{name: range_ for name, range_ in self.ranges.items() if name in names})

    def changes_model(self) -> bool:
        """Return whether the condition changes the physics of the object or the arm."""
        return not self.ranges.keys().isdisjoint(_MODEL)

    def draw(self, seed: int) -> dict[str, Any]:
        """Return the values drawn for the episode of a seed, by the names of the ranges and in their units.

        Each value has a random stream of its own, so that adding a range leaves the other values unchanged.
        camera_shift and camera_turn have one vector (3,) per camera, in the camera's own frame.
        """
        return {name: _draw(name, range_, rng_for(seed, f"condition {name}")) for name, range_ in self.ranges.items()}

    def to_json(self) -> dict[str, Any]:
        """Return name and ranges as plain JSON values."""
        return {"name": self.name} | {name: list(range_) for name, range_ in self.ranges.items()}

    def __str__(self) -> str:
        said = ", ".join(f"{name} {words(range_)}" for name, range_ in self.ranges.items())
        return f"{self.name} ({said})" if said else self.name


def merged(conditions: Sequence[Condition]) -> Condition:
    """Return one condition with the ranges of all, named after all; later ranges override earlier ones."""
    ranges = {name: range_ for condition in conditions for name, range_ in condition.ranges.items()}
    return Condition("_".join(condition.name for condition in conditions)[: checks.LONGEST_NAME], **ranges)


def turn_of(conditions: Sequence[Condition], seed: int) -> Condition:
    """Return the condition of a seed's episode: conditions take turns; if there are none, it is nominal."""
    return conditions[seed % len(conditions)] if conditions else NOMINAL


def draw(conditions: Sequence[Condition], seed: int, shape: NameOrPath = "") -> dict[str, Any]:
    """Return the values drawn for the episode of a seed, by name, from the condition that `turn_of` returns.

    shape: as in `EnvConfig.object`; if it is `any`, one of `KINDS` is drawn, too.
    """
    drawn = turn_of(conditions, seed).draw(seed)
    if not draws_shape(shape):
        return drawn
    return {"shape": KINDS[int(rng_for(seed, "condition shape").integers(len(KINDS)))]} | drawn


def words(range_: Range) -> str:
    """Return a range as people read it: `0.03 to 0.07`."""
    low, high = range_
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _draw(name: str, range_: Range, rng: np.random.Generator) -> Any:
    if name in _WHOLE:
        count = int(rng.integers(int(range_[0]), int(range_[1]), endpoint=True))
        return [count, int(rng.integers(_SEEDS))] if name == "clutter" else count
    if name in ("colour", "table"):
        return [float(value) for value in rng.uniform(range_[0], range_[1], 3)]
    if name in ("camera_shift", "camera_turn"):
        return {camera: _vector(rng, range_) for camera in CAMERAS}
    return float(rng.uniform(*range_))


def _vector(rng: np.random.Generator, lengths: Range) -> list[float]:
    """A vector of random length in a uniformly random direction."""
    direction = rng.normal(size=3)
    return [float(value) for value in rng.uniform(*lengths) * direction / np.linalg.norm(direction)]


def _range(condition: str, name: str, given: Any) -> Range:
    """A range as a tuple, from what Python or YAML gives: a pair or a number."""
    if name not in _BOUNDS:
        raise UnknownName(f"key in {condition}:", name[: checks.LONGEST_NAME], _BOUNDS)
    what, ends = f"{condition}: {name}", given if isinstance(given, list | tuple) else (given, given)
    try:
        low, high = (checks.number(what, end) for end in ends)
    except (ManipError, ValueError):
        raise UsageError(f"{what} is {checks.shorten(given)}; expected a number, or [low, high]") from None
    least, most = _BOUNDS[name]
    if not least <= low <= high <= most:
        raise UsageError(f"{what} is [{low}, {high}]; expected low <= high, both from {least} to {most}")
    if name in _WHOLE and (low % 1 or high % 1):
        raise UsageError(f"{what} is [{low}, {high}]; expected whole numbers")
    return given if isinstance(given, tuple) else (low, high)


def _overlap(name: str, asked: Range, sizes: Range) -> Range:
    """The sizes that are both asked for and possible in a task."""
    low, high = max(asked[0], sizes[0]), min(asked[1], sizes[1])
    if low > high:
        takes = f"{sizes[0]:.3g} to {sizes[1]:.3g} m"
        raise UsageError(f"{name}: size is {words(asked)} m, and the task takes objects of {takes}; choose other sizes")
    return low, high


NOMINAL = Condition()
