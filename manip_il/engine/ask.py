"""When to ask the expert: which of the states that a learner visits get a label.

Written `kind:parameter`, as in `every`, `one`, `probability:0.1`, `safety:0.5`. Differences between actions are
measured in longest steps (see `action_gap`), so that a bound means the same for every robot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UnknownName, UsageError
from manip_il.rollout import Turn
from manip_il.seeding import rng_for

F32, F64 = NDArray[np.float32], NDArray[np.float64]

KINDS = {
    "every": "in every state (Ross et al. 2011)",
    "one": "once an episode, at a drawn step (with one episode a round: Stagger, Li & Zhang 2025)",
    "probability": "probability:0.1, at each step by chance",
    "ensemble": "ensemble:0.2, where policies that differ by their seed disagree by more (Menda et al. 2019)",
    "likelihood": "likelihood:-2, where the policy finds its own action less likely, in nats a joint",
    "safety": "safety:0.5, where expert and learner differ by more (Zhang & Cho 2017)",
}
_PLAIN = ("every", "one")


@dataclass(frozen=True)
class Ask:
    """A rule for asking, with its parameter; `bound` is nan for those without one."""

    kind: str = "every"
    bound: float = math.nan

    @classmethod
    def parse(cls, text: str) -> Ask:
        """Raises `UnknownName` for the kind, `UsageError` for a parameter that is missing, amiss or too much."""
        kind, colon, parameter = text.partition(":")
        if kind not in KINDS:
            raise UnknownName("way to ask", kind, KINDS)
        if kind in _PLAIN:
            if colon:
                raise UsageError(f"ask is {text!r}; expected {kind} alone")
            return cls(kind)
        try:
            bound = float(parameter)
        except ValueError:
            raise UsageError(f"ask is {text!r}; expected {kind}:NUMBER ({KINDS[kind]})") from None
        return cls(kind, bound)

    def __str__(self) -> str:
        return self.kind if self.kind in _PLAIN else f"{self.kind}:{self.bound:g}"

    def __post_init__(self) -> None:
        if self.kind in _PLAIN:
            return
        if self.kind == "probability" and not 0 < self.bound <= 1:
            raise UsageError(f"ask is probability:{self.bound:g}; expected more than 0, at most 1")
        if self.kind in ("ensemble", "safety") and not 0 <= self.bound < math.inf:
            raise UsageError(f"ask is {self.kind}:{self.bound:g}; expected 0 or more")
        if not math.isfinite(self.bound):
            raise UsageError(f"ask is {self.kind}:{self.bound:g}; expected a finite number")


class Gate(Protocol):
    """Decides, knowing what the learner would do."""

    def wants(self, turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        """Whether the expert is asked in each turn. actions: the learner's, (n,) each."""
        ...


class Confidence(Protocol):
    """A learner that knows how likely it finds an action."""

    def log_likelihood(self, states: F32, environment_states: F32, actions: F64) -> F64:
        """Log-density or log-probability of each row's action, a dimension, (B,)."""
        ...


class Member(Protocol):
    """Another policy of an ensemble."""

    def act(
        self,
        states: F32,
        environment_states: F32,
        images: Mapping[str, NDArray[np.uint8]],
        episodes: Sequence[int],
    ) -> F64:
        """One action a row, (B, n)."""
        ...

    def reset(self, episodes: Sequence[int]) -> None:
        """Forget the past of episodes that begin."""
        ...


def action_gap(left: F64, right: F64, scale: F64) -> F64:
    """The largest difference over the dimensions of two actions (..., n), in units of `scale` (n,)."""
    return np.abs((left - right) / scale).max(axis=-1)


def drawn_step(seed: int, steps: int) -> int:
    """One step of `steps`, the same for the same episode."""
    return int(rng_for(seed, "ask").integers(steps))


class Everywhere:
    """Every state."""

    def wants(self, turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        """All of them."""
        return [True] * len(turns)


class AtDrawnStep:
    """One step an episode, drawn evenly from the first `horizon`; an episode that ends before is not asked about."""

    def __init__(self, horizon: int):
        self._horizon = horizon
        self._steps: dict[int, int] = {}

    def wants(self, turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        """Whether this is the step."""
        return [turn.step == self._step(turn.seed) for turn in turns]

    def _step(self, seed: int) -> int:
        if seed not in self._steps:
            self._steps[seed] = drawn_step(seed, self._horizon)
        return self._steps[seed]


class ByChance:
    """Each step with the same probability, drawn from the episode's own generator."""

    def __init__(self, probability: float):
        self._probability = probability
        self._rngs: dict[int, np.random.Generator] = {}

    def wants(self, turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        """One draw a turn."""
        rngs = [self._rngs.setdefault(turn.seed, rng_for(turn.seed, "ask")) for turn in turns]
        return [rng.uniform() < self._probability for rng in rngs]


class WhereUnsafe:
    """Where the expert would do something else. It asks everywhere to know, and keeps what it needs."""

    def __init__(self, bound: float, scale: F64):
        self._bound, self._scale = bound, scale

    def wants(self, turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        """Whether the two are further apart than the bound."""
        labels = [turn.label or turn.peek() for turn in turns]
        return [
            bool(action_gap(label.action, action, self._scale) > self._bound)
            for label, action in zip(labels, actions, strict=True)
        ]


class WhereDisputed:
    """Where the actions of an ensemble spread: root mean square distance to their mean, in the worst dimension."""

    def __init__(self, bound: float, others: Sequence[Member], cameras: Sequence[str], scale: F64):
        self._bound, self._others, self._cameras, self._scale = bound, others, cameras, scale

    def wants(self, turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        """Whether the spread is above the bound."""
        started = [turn.seed for turn in turns if turn.step == 0]
        answers = [np.stack(actions)]
        for member in self._others:
            if started:
                member.reset(started)
            answers.append(member.act(*seen(turns, self._cameras), [turn.seed for turn in turns]))
        spread = (np.stack(answers).std(axis=0) / self._scale).max(axis=-1)
        return (spread > self._bound).tolist()


class WhereUnsure:
    """Where the learner finds its own action unlikely."""

    def __init__(self, bound: float, learner: Confidence):
        self._bound, self._learner = bound, learner

    def wants(self, turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        """Whether its log-likelihood is below the bound."""
        states, environment_states, _ = seen(turns, ())
        return (self._learner.log_likelihood(states, environment_states, np.stack(actions)) < self._bound).tolist()


def seen(turns: Sequence[Turn], cameras: Sequence[str]) -> tuple[F32, F32, dict[str, NDArray[np.uint8]]]:
    """The turns' observations as a policy takes them: (B, n), (B, k), camera -> (B, H, W, 3)."""
    observations = [turn.observation for turn in turns]
    return (
        np.stack([one.state for one in observations]),
        np.stack([one.environment_state for one in observations]),
        {camera: np.stack([one.images[camera] for one in observations]) for camera in cameras},
    )
