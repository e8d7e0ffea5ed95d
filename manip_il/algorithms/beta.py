"""beta_i: how often the expert drives in round i (Ross, Gordon & Bagnell 2011, section 3.6)."""

from __future__ import annotations

from dataclasses import dataclass

from manip_il.errors import UnknownName, UsageError

SCHEDULES = {
    "constant": "constant:0.0 lets the learner drive alone from round 1 on (the paper's parameter-free choice)",
    "linear": "linear:5 falls evenly from 1 in round 0 to 0 in round 5",
    "exponential": "exponential:0.5 is 0.5 to the power of the round",
}


@dataclass(frozen=True)
class BetaSchedule:
    """`kind:parameter`, as in `constant:0`, `linear:5`, `exponential:0.5`. Round 0 is the expert's own: beta is 1.

    Raises `UnknownName` for the kind, `UsageError` for a parameter out of range.
    """

    kind: str
    parameter: float

    def __post_init__(self) -> None:
        if self.kind not in SCHEDULES:
            raise UnknownName("beta schedule", self.kind, SCHEDULES)
        if not (self.parameter >= 1 if self.kind == "linear" else 0 <= self.parameter <= 1):
            expected = "at least 1 round" if self.kind == "linear" else "0 to 1"
            raise UsageError(f"beta is '{self}'; expected {expected} after {self.kind}:")

    @classmethod
    def parse(cls, text: str) -> BetaSchedule:
        """Read what `str` writes; `UsageError` also for a parameter that is missing or no number."""
        kind, _, parameter = text.partition(":")
        number = _number(parameter)
        if kind not in SCHEDULES and _number(text) is not None:
            raise UsageError(f"beta is {text!r}; expected constant:{text}, linear:ROUNDS or exponential:B")
        if kind in SCHEDULES and number is None:
            raise UsageError(f"beta is {text!r}; expected {kind}:NUMBER ({SCHEDULES[kind]})")
        return cls(kind, number or 0.0)

    def __str__(self) -> str:
        return f"{self.kind}:{self.parameter:g}"

    def __call__(self, round_: int) -> float:
        """Return the probability that the expert drives a step of this round."""
        if round_ == 0:
            return 1.0
        if self.kind == "constant":
            return self.parameter
        if self.kind == "linear":
            return max(0.0, 1.0 - round_ / self.parameter)
        return self.parameter**round_


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
