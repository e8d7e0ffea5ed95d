"""Rewards of `carry`: what a metre of path costs for each named feature, from a name, a file or a text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.errors import ManipError, UsageError, nearest, shorten

FEATURES = (
    "length",  # 1
    "height",  # of the object over where it rests, in tenths of a metre
    "above_vase",  # 1 over it, and within about 2 cm beside it
    "above_laptop",
    "above_candle",
    "near_vase",  # 1 at it or over it, 0.6 at 8 cm beside it, 0.14 at 16 cm
    "near_laptop",
    "near_candle",
    "near_edge",  # 1 at the edge of the table or beyond it, 0.6 at 5 cm
)
MOST = 1e6  # of a weight
_FILES = (".yaml", ".yml", ".json")
_LARGEST = 1 << 20  # of a file [bytes]
_WHAT = "a reward: names and weights"
_FORMS = "a file of .yaml or .json, or NAME=NUMBER,..."


@dataclass(frozen=True)
class Reward:
    """Weights, in the order of `FEATURES`: the costs of a metre of path.

    Raises `UsageError` for weights that are not finite or below 0, and for a `length` of 0: a path without a cost of
    its length may be of any.
    """

    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.weights) != len(FEATURES):
            raise UsageError(
                f"a reward of {len(self.weights)} weights; expected {len(FEATURES)}: {', '.join(FEATURES)}"
            )
        for name, weight in zip(FEATURES, self.weights, strict=True):
            if not (math.isfinite(weight) and 0 <= weight <= MOST):
                raise UsageError(f"weight of {name} is {weight:g}; expected a finite number from 0 to {MOST:g}")
        if not self.weights[0]:
            raise UsageError("weight of length is 0; expected more than 0: paths would be of any length")

    @classmethod
    def of(cls, weights: Mapping[str, object]) -> Reward:
        """Return the reward of weights by name, 0 where none is said.

        Raises `UsageError` for a name that is no feature, and for what is no number.
        """
        for name in weights:
            if name not in FEATURES:
                known = ", ".join(FEATURES)
                raise UsageError(f"unknown feature {shorten(name)}{nearest(name, FEATURES)}; known: {known}")
        if "length" not in weights:
            raise UsageError("a reward without a weight of length; expected one above 0")
        try:
            return cls(tuple(checks.number(f"weight of {name}", weights.get(name, 0.0)) for name in FEATURES))
        except UsageError:
            raise
        except ManipError as error:
            raise UsageError(str(error)) from None

    @classmethod
    def parse(cls, text: str) -> Reward:
        """Return the reward that a text means: a shipped one's name, a file, or `NAME=NUMBER,...`.

        Raises `UsageError` for any other text, and for a file that cannot be read or is no reward.
        """
        if text in TASTES:
            return TASTES[text]
        if Path(text).suffix in _FILES:
            return cls._read(Path(text))
        if "=" not in text:
            raise UsageError(
                f"unknown reward {shorten(text)}{nearest(text, TASTES)}; expected {', '.join(TASTES)}, {_FORMS}"
            )
        return cls.of(_named(text))

    @classmethod
    def _read(cls, path: Path) -> Reward:
        """Read YAML of names and weights, or JSON with the lists `names` and `weights` and whatever else."""
        try:
            if path.suffix == ".json":
                tree: Any = checks.parse_json(str(path), checks.read_bytes(path, _WHAT, _LARGEST, UsageError))
            else:
                tree = checks.read_yaml(path, _WHAT)
            tree = checks.mapping(str(path), tree)
            return cls.of(_listed(path, tree) if "names" in tree else tree)
        except ManipError as error:
            raise UsageError(str(error) if str(path) in str(error) else f"{path}: {error}") from None

    @property
    def text(self) -> str:
        """Name of a shipped reward, else `NAME=NUMBER,...` of the weights that are not 0."""
        for name, one in TASTES.items():
            if one == self:
                return name
        return self.numbers

    @property
    def numbers(self) -> str:
        """`NAME=NUMBER,...` of the weights that are not 0, exactly."""
        pairs = zip(FEATURES, self.weights, strict=True)
        return ",".join(f"{name}={_short(weight)}" for name, weight in pairs if weight)


def _named(text: str) -> dict[str, object]:
    found = dict[str, object]()
    for word in text.split(","):
        name, equals, value = (part.strip() for part in word.partition("="))
        if not equals:
            raise UsageError(f"{shorten(word)} in a reward; expected NAME=NUMBER")
        if name in found:
            raise UsageError(f"{name} stands twice in a reward; expected every feature once")
        try:
            found[name] = float(value)
        except ValueError:
            raise UsageError(f"weight of {name} is {shorten(value)}; expected a number") from None
    return found


def _listed(path: Path, tree: Mapping[str, Any]) -> dict[str, object]:
    names = [checks.text(f"{path}: a name", name) for name in checks.array(f"{path}: names", tree["names"])]
    weights = checks.array(f"{path}: weights", tree.get("weights"))
    if len(names) != len(weights) or len(set(names)) != len(names):
        raise UsageError(f"{path}: {len(names)} names, {len(set(names))} of them different, and {len(weights)} weights")
    return dict(zip(names, weights, strict=True))


def _short(weight: float) -> str:
    short = f"{weight:g}"
    return short if float(short) == weight else repr(weight)


TASTES: dict[str, Reward] = {
    "careful": Reward((1.0, 1.0, 8.0, 6.0, 12.0, 4.0, 2.0, 6.0, 4.0)),
    "low": Reward((1.0, 6.0, 4.0, 1.0, 4.0, 1.0, 0.5, 1.0, 1.0)),
    "hasty": Reward((1.0, 0.2, 0.5, 0.0, 1.0, 0.2, 0.0, 0.5, 0.2)),
}
DEFAULT = "careful"
REWARD_HELP = f"{', '.join(TASTES)}, {_FORMS}; what carry minimises"
