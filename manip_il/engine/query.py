"""When the expert is queried: which of the states that a learner visits get a label.

Rules are written `kind:parameter`, as in `every`, `one`, `probability:0.1`, `safety:0.5`. Differences between actions
are measured in longest steps (see `action_gap`), so that a bound means the same for every robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UnknownName, UsageError
from manip_il.policy import Policy
from manip_il.rollout import Turn
from manip_il.seeding import rng_for

F32, F64 = NDArray[np.float32], NDArray[np.float64]
LabelMode = Literal["per_state", "takeover", "branch", "last"]  # what the expert gives; see `RolloutJob`

KINDS = {
    "every": "in every state (Ross et al. 2011)",
    "one": "once an episode, at a drawn step (with one episode a round: Stagger, Li & Zhang 2025)",
    "probability": "probability:0.1, at each step by chance",
    "ensemble": "ensemble:0.2, where policies that differ by their seed disagree by more (Menda et al. 2019)",
    "likelihood": "likelihood:-2, where the policy finds its own action less likely, in nats a joint",
    "safety": "safety:0.5, where expert and learner differ by more (Zhang & Cho 2017)",
}
_PLAIN = ("every", "one")
_STREAM = "ask"  # of random numbers; another name would draw other states


@dataclass(frozen=True)
class QueryRule:
    """When the expert is queried, with the rule's parameter; `bound` is 0 for those without one."""

    kind: str = "every"
    bound: float = 0.0

    @classmethod
    def parse(cls, text: str) -> QueryRule:
        """Raises `UnknownName` for the kind, `UsageError` for a parameter that is missing, amiss or too much."""
        kind, colon, parameter = text.partition(":")
        if kind in _PLAIN and colon:
            raise UsageError(f"query is {text!r}; expected {kind} alone")
        if kind in _PLAIN or kind not in KINDS:
            return cls(kind)
        try:
            bound = float(parameter)
        except ValueError:
            raise UsageError(f"query is {text!r}; expected {kind}:NUMBER ({KINDS[kind]})") from None
        return cls(kind, bound)

    def __str__(self) -> str:
        return self.kind if self.kind in _PLAIN else f"{self.kind}:{self.bound:g}"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnknownName("query rule", self.kind, KINDS)
        if self.kind in _PLAIN:
            return
        if self.kind == "probability" and not 0 < self.bound <= 1:
            raise UsageError(f"query is probability:{self.bound:g}; expected more than 0, at most 1")
        if self.kind in ("ensemble", "safety") and not 0 <= self.bound < math.inf:
            raise UsageError(f"query is {self.kind}:{self.bound:g}; expected 0 or more")
        if not math.isfinite(self.bound):
            raise UsageError(f"query is {self.kind}:{self.bound:g}; expected a finite number")


Gate = Callable[[Sequence[Turn], Sequence[F64]], list[bool]]
"""Whether the expert is queried in each turn, knowing the actions (n,) that the learner would execute."""


def action_gap(left: F64, right: F64, scale: F64) -> F64:
    """Return the largest difference over the dimensions of two actions (..., n), in units of `scale` (n,)."""
    return np.abs((left - right) / scale).max(axis=-1)


def drawn_step(seed: int, steps: int) -> int:
    """Return one step of `steps`, the same for the same episode."""
    return int(rng_for(seed, _STREAM).integers(steps))


def everywhere(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
    """Query in every state."""
    return [True] * len(turns)


def at_drawn_step(horizon: int) -> Gate:
    """Query once an episode, at a step drawn evenly from the first `horizon`; never where it ends before."""
    return lambda turns, actions: [turn.step == drawn_step(turn.seed, horizon) for turn in turns]


def by_chance(probability: float) -> Gate:
    """Query in each step with the same probability, drawn from the episode's own generator."""
    rngs: dict[int, np.random.Generator] = {}

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        own = [rngs.setdefault(turn.seed, rng_for(turn.seed, _STREAM)) for turn in turns]
        return [rng.uniform() < probability for rng in own]

    return gate


def where_unsafe(bound: float, scale: F64) -> Gate:
    """Query where the expert would do something else: it answers everywhere for that, and labels where it would."""

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        labels = [turn.label or turn.peek() for turn in turns]
        pairs = zip(labels, actions, strict=True)
        return [bool(action_gap(label.action, action, scale) > bound) for label, action in pairs]

    return gate


def where_disputed(bound: float, others: Sequence[Policy], cameras: Sequence[str], scale: F64) -> Gate:
    """Query where the actions of an ensemble spread: root mean square distance to their mean, worst dimension."""

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        started = [turn.seed for turn in turns if turn.step == 0]
        answers = [np.stack(actions)]
        for member in others:
            if started:
                member.reset(started)
            answers.append(member.act(*seen(turns, cameras), [turn.seed for turn in turns]))
        return ((np.stack(answers).std(axis=0) / scale).max(axis=-1) > bound).tolist()

    return gate


def where_unsure(bound: float, learner: Policy) -> Gate:
    """Query where the learner finds its own action less likely than `bound` [nats a dimension]."""

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        chosen = np.stack(actions)
        return (learner.log_prob(*seen(turns, learner.cameras), chosen) / chosen.shape[1] < bound).tolist()

    return gate


def seen(turns: Sequence[Turn], cameras: Sequence[str]) -> tuple[F32, F32, dict[str, NDArray[np.uint8]]]:
    """Return the turns' observations as a policy takes them: (B, n), (B, k), camera -> (B, H, W, 3)."""
    observations = [turn.observation for turn in turns]
    return (
        np.stack([one.state for one in observations]),
        np.stack([one.environment_state for one in observations]),
        {camera: np.stack([one.images[camera] for one in observations]) for camera in cameras},
    )
