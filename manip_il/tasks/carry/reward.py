"""Rewards of `carry`: what a metre of path costs for each named feature, from a name, a file or a text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError, shorten

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


@dataclass(frozen=True)
class Reward:
    """Weights, in the order of `FEATURES`: the costs of a metre of path.

    Raises `UsageError` for weights that are not finite or below 0, and for a `length` of 0: paths could otherwise have
    any length.
    """

    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, weight in zip(FEATURES, self.weights, strict=True):
            if not 0 <= weight <= MOST:
                raise UsageError(f"weight of {name} is {weight:g}; expected 0 to {MOST:g}")
        if not self.weights[0]:
            raise UsageError("weight of length is 0; expected more, as paths could otherwise have any length")

    @classmethod
    def of(cls, weights: Mapping[str, float]) -> Reward:
        """Return the reward of weights by name; missing ones are 0. Raises `UnknownName` for any other name."""
        for name in weights:
            if name not in FEATURES:
                raise UnknownName("feature", name, FEATURES)
        return cls(tuple(weights.get(name, 0.0) for name in FEATURES))

    @classmethod
    def parse(cls, text: str) -> Reward:
        """Return the reward that a text describes: a shipped one's name, a `reward.json`, or `NAME=NUMBER,...`.

        Only the lists `names` and `weights` of a file are read. Raises `UsageError` for anything else.
        """
        if text in TASTES:
            return TASTES[text]
        if not text.endswith(".json") and "=" not in text:
            raise UnknownName("reward", text, TASTES, f"expected {', '.join(TASTES)}, reward.json or NAME=NUMBER,...")
        wanted = "NAME=NUMBER,..."
        try:
            if text.endswith(".json"):
                wanted = "names, and a number for each in weights"
                tree = checks.read_json(Path(text), "a reward: names and weights")
                pairs = list(zip(tree["names"], tree["weights"], strict=True))
            else:
                pairs = [word.split("=") for word in text.split(",")]
            weights = {str(name).strip(): float(weight) for name, weight in pairs}
        except ManipError as error:
            raise UsageError(str(error)) from None
        except (LookupError, TypeError, ValueError) as error:
            raise UsageError(f"reward is {shorten(text)}: {checks.one_line(error)}; expected {wanted}") from None
        return cls.of(weights)

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
