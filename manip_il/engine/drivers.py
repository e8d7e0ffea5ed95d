"""Drivers of a rollout: the expert, a learner, a mixture of both, or chance; and when the expert is queried.

Query rules are written `kind:parameter`, as in `every`, `one`, `probability:0.1`, `safety:0.5`. Differences between
actions are measured in longest steps (see `action_gap`), so that a bound means the same for every robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import Actor, Policy, ReadsInstructions
from manip_il.robots.action_space import ActionSpace
from manip_il.rollout import Driver, Turn
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
    """Rule that says when the expert is queried; `bound` is 0 for kinds without a parameter."""

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


class ExpertDriver:
    """Executes the expert's label."""

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the label (n,) of every turn."""
        return [(turn.query().action, Actor.EXPERT) for turn in turns]


class NoisyExpertDriver:
    """Executes the label with Gaussian noise: DART (Laskey et al. 2017). covariance: (n, n), of actions."""

    def __init__(self, covariance: F64):
        self._mean, self._covariance = np.zeros(len(covariance)), covariance
        self._rngs = _Generators("dart")

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the label (n,) plus a draw from each episode's own generator."""
        noise = [self._rngs[turn.seed].multivariate_normal(self._mean, self._covariance) for turn in turns]
        return [(turn.query().action + one, Actor.NOISY_EXPERT) for turn, one in zip(turns, noise, strict=True)]


class LearnerDriver:
    """Executes the learner's action, one call a step for all episodes."""

    def __init__(self, policy: Policy):
        self._policy = policy

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the policy's action (n,) in every turn."""
        return [(action, Actor.LEARNER) for action in _policy_actions(self._policy, turns)]


class MixtureDriver:
    """pi_i = beta_i pi* + (1 - beta_i) pi_hat: each step is the expert's with probability beta (Ross et al. 2011)."""

    def __init__(self, policy: Policy, beta: float):
        self._learner, self._beta = LearnerDriver(policy), beta
        self._rngs = _Generators("mixture")

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the learner's or the expert's action (n,), by each episode's own generator."""
        actions = self._learner.act(turns)
        for i, turn in enumerate(turns):
            if self._rngs[turn.seed].uniform() < self._beta:
                actions[i] = (turn.query().action, Actor.EXPERT)
        return actions


class QueryingDriver:
    """Another driver, with a query of the expert in the turns that a gate selects."""

    def __init__(self, driver: Driver, gate: Gate):
        self._driver, self._gate = driver, gate

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the other driver's action (n,) in every turn."""
        actions = self._driver.act(turns)
        for turn, wanted in zip(turns, self._gate(turns, [action for action, _ in actions]), strict=True):
            if wanted:
                turn.query()
        return actions


class TakeoverDriver:
    """The learner, until its gate selects a turn, and from then on the expert."""

    def __init__(self, learner: Driver, gate: Gate):
        self._learner, self._gate = learner, gate
        self._taken: set[int] = set()

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return the learner's action (n,), or the expert's in episodes that it has taken over."""
        rolling = [turn for turn in turns if turn.seed not in self._taken]
        actions: dict[int, tuple[F64, Actor]] = {}
        if rolling:
            learned = self._learner.act(rolling)
            wanted = self._gate(rolling, [action for action, _ in learned])
            actions = {turn.seed: one for turn, one in zip(rolling, learned, strict=True)}
            self._taken.update(turn.seed for turn, wants in zip(rolling, wanted, strict=True) if wants)
        return [
            (turn.query().action, Actor.EXPERT) if turn.seed in self._taken else actions[turn.seed] for turn in turns
        ]


class RandomDriver:
    """Joint targets drawn evenly within the longest step of the measured joints, any gripper opening."""

    def __init__(self, actions: ActionSpace):
        self._actions, self._rngs = actions, _Generators("random policy")

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return a drawn action (n,) for every turn."""
        draw, rngs = self._actions.random_near, self._rngs
        return [(draw(turn.observation.state, rngs[turn.seed]), Actor.LEARNER) for turn in turns]


def action_gap(left: F64, right: F64, scale: F64) -> F64:
    """Return the largest difference over the dimensions of two actions (..., n), in units of `scale` (n,)."""
    return np.abs((left - right) / scale).max(axis=-1)


def drawn_step(seed: int, steps: int) -> int:
    """Return one step of `steps`, the same for the same episode."""
    return int(rng_for(seed, _STREAM).integers(steps))


def at_every_step() -> Gate:
    """Query in every state."""
    return lambda turns, actions: [True] * len(turns)


def at_drawn_step(horizon: int) -> Gate:
    """Query once an episode, at a step drawn evenly from the first `horizon`; never where it ends before."""
    return lambda turns, actions: [turn.step == drawn_step(turn.seed, horizon) for turn in turns]


def by_chance(probability: float) -> Gate:
    """Query in each step with the same probability, drawn from the episode's own generator."""
    rngs = _Generators(_STREAM)
    return lambda turns, actions: [rngs[turn.seed].uniform() < probability for turn in turns]


def on_gap(bound: float, scale: F64) -> Gate:
    """Query where expert and learner differ by more than `bound`, in units of `scale` (n,).

    To know that, the expert labels every state, and its labels are kept where they differ.
    """

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        labels = [turn.label or turn.peek() for turn in turns]
        pairs = zip(labels, actions, strict=True)
        return [bool(action_gap(label.action, action, scale) > bound) for label, action in pairs]

    return gate


def on_disagreement(bound: float, others: Sequence[Policy], scale: F64) -> Gate:
    """Query where the actions of an ensemble spread: root mean square distance to their mean, worst dimension.

    scale: (n,), its unit.
    """

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        answers = [np.stack(actions), *(_policy_actions(member, turns) for member in others)]
        return ((np.stack(answers).std(axis=0) / scale).max(axis=-1) > bound).tolist()

    return gate


def on_low_likelihood(bound: float, learner: Policy) -> Gate:
    """Query where the learner finds its own action less likely than `bound` [nats a dimension]."""

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> list[bool]:
        stacked = np.stack(actions)
        observed = _observations(turns, learner.cameras)
        return (learner.log_prob(*observed, stacked) / stacked.shape[1] < bound).tolist()

    return gate


class _Generators(dict[int, np.random.Generator]):
    """A random generator for every episode, by its seed."""

    def __init__(self, stream: str):
        super().__init__()
        self._stream = stream

    def __missing__(self, seed: int) -> np.random.Generator:
        return self.setdefault(seed, rng_for(seed, self._stream))


def _policy_actions(policy: Policy, turns: Sequence[Turn]) -> F64:
    """A policy's action in every turn, (B, n); one with a memory begins anew where an episode does."""
    if started := [turn.seed for turn in turns if turn.step == 0]:
        policy.reset(started)
        if isinstance(policy, ReadsInstructions):
            policy.instruct({turn.seed: turn.observation.instruction for turn in turns if turn.step == 0})
    return policy.act(*_observations(turns, policy.cameras), [turn.seed for turn in turns])


def _observations(turns: Sequence[Turn], cameras: Sequence[str]) -> tuple[F32, F32, dict[str, NDArray[np.uint8]]]:
    """The turns' observations as a policy takes them: (B, n), (B, k), camera -> (B, H, W, 3)."""
    observations = [turn.observation for turn in turns]
    return (
        np.stack([one.state for one in observations]),
        np.stack([one.environment_state for one in observations]),
        {camera: np.stack([one.images[camera] for one in observations]) for camera in cameras},
    )
