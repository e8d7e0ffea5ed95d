"""Rewards of `carry`: what a metre of path costs for each named feature, from a name, a file or a text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from manip_il import checks
from manip_il.errors import ManipError, UsageError, nearest, shorten

FEATURES = (
    "length",  # 1
    "height",  # height of the object over its resting height, in tenths of a metre
    "above_vase",  # 1 over it, and within about 2 cm beside it
    "above_laptop",
    "above_candle",
    "near_vase",  # 1 at it or over it, 0.6 at 8 cm beside it, 0.14 at 16 cm
    "near_laptop",
    "near_candle",
    "near_edge",  # 1 at the edge of the table or beyond it, 0.6 at 5 cm
)
MOST = 1e6  # largest weight
_LARGEST = 1 << 20  # largest file [bytes]


@dataclass(frozen=True)
class Reward:
    """Weights, in the order of `FEATURES`: the costs of a metre of path.

    Raises `UsageError` for weights that are not finite or below 0, and for a `length` of 0: paths without a cost of
    length could have any.
    """

    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, weight in zip(FEATURES, self.weights, strict=True):
            if not (math.isfinite(weight) and 0 <= weight <= MOST):
                raise UsageError(f"weight of {name} is {weight:g}; expected a finite number from 0 to {MOST:g}")
        if not self.weights[0]:
            raise UsageError("weight of length is 0; expected more than 0: paths would be of any length")

    @classmethod
    def of(cls, weights: Mapping[str, object]) -> Reward:
        """Return the reward of weights by name; missing ones are 0.

        Raises `UsageError` for a name that is no feature, and for a value that is no number.
        """
        for name in weights:
            if name not in FEATURES:
                known = ", ".join(FEATURES)
                raise UsageError(f"unknown feature {shorten(name)}{nearest(name, FEATURES)}; known: {known}")
        try:
            return cls(tuple(checks.number(f"weight of {name}", weights.get(name, 0.0)) for name in FEATURES))
        except ManipError as error:
            raise UsageError(str(error)) from None

    @classmethod
    def parse(cls, text: str) -> Reward:
        """Return the reward that a text describes: a shipped one's name, a `reward.json`, or `NAME=NUMBER,...`.

        Raises `UsageError` for any other text, and for a file that cannot be read or is no reward.
        """
        if text in TASTES:
            return TASTES[text]
        if text.endswith(".json"):
            return cls._read(Path(text))
        if "=" not in text:
            known = ", ".join(TASTES)
            near = nearest(text, TASTES)
            raise UsageError(f"unknown reward {shorten(text)}{near}; expected {known}, reward.json, or NAME=NUMBER,...")
        weights = dict[str, object]()
        for word in text.split(","):
            name, _, value = (part.strip() for part in word.partition("="))
            try:
                weights[name] = float(value)
            except ValueError:
                raise UsageError(f"weight of {name} is {shorten(value)}; expected a number") from None
        return cls.of(weights)

    @classmethod
    def _read(cls, path: Path) -> Reward:
        """Read the lists `names` and `weights` of a `reward.json`, and ignore the rest."""
        try:
            tree = checks.mapping(str(path), checks.read_json(path, "a reward: names and weights", _LARGEST))
            names, weights = (checks.array(f"{path}: {key}", tree.get(key)) for key in ("names", "weights"))
            return cls.of(dict(zip(map(str, names), weights, strict=True)))
        except (ManipError, ValueError) as error:
            raise UsageError(str(error) if str(path) in str(error) else f"{path}: {error}") from None

    @property
    def numbers(self) -> str:
        """`NAME=NUMBER,...` of the nonzero weights, exactly."""
        pairs = zip(FEATURES, self.weights, strict=True)
        return ",".join(f"{name}={_short(weight)}" for name, weight in pairs if weight)


def _short(weight: float) -> str:
    short = f"{weight:g}"
    return short if float(short) == weight else repr(weight)


TASTES: dict[str, Reward] = {
    "careful": Reward((1.0, 1.0, 8.0, 6.0, 12.0, 4.0, 2.0, 6.0, 4.0)),
    "low": Reward((1.0, 6.0, 4.0, 1.0, 4.0, 1.0, 0.5, 1.0, 1.0)),
    "hasty": Reward((1.0, 0.2, 0.5, 0.0, 1.0, 0.2, 0.0, 0.5, 0.2)),
}
DEFAULT = "careful"
