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
    """`kind:parameter`, as in `constant:0`, `linear:5`, `exponential:0.5`. Round 0 is the expert's own: beta is 1."""

    kind: str
    parameter: float

    @classmethod
    def parse(cls, text: str) -> BetaSchedule:
        """Raises `UnknownName` for the kind, `UsageError` for a parameter out of range."""
        kind, _, parameter = text.partition(":")
        if kind not in SCHEDULES and _is_number(text):
            raise UsageError(f"beta is {text!r}; expected constant:{text}, linear:ROUNDS or exponential:B")
        if kind not in SCHEDULES:
            raise UnknownName("beta schedule", kind, SCHEDULES)
        try:
            value = float(parameter)
        except ValueError:
            raise UsageError(f"beta is {text!r}; expected {kind}:NUMBER ({SCHEDULES[kind]})") from None
        sound = value >= 1 if kind == "linear" else 0 <= value <= 1
        if not sound:
            expected = "at least 1 round" if kind == "linear" else "0 to 1"
            raise UsageError(f"beta is {text!r}; expected {expected} after {kind}:")
        return cls(kind, value)

    def at(self, round_: int) -> float:
        """The probability that the expert drives a step of this round."""
        if round_ == 0:
            return 1.0
        if self.kind == "constant":
            return self.parameter
        if self.kind == "linear":
            return max(0.0, 1.0 - round_ / self.parameter)
        return self.parameter**round_


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
