"""When the expert is queried, and what it gives then.

A rule is written `kind:bound`, as in `every`, `one`, `probability:0.1` or `safety:0.5`. `rollout` applies it in every
step to the learner's actions, and nowhere else is the expert queried for a label. Differences between actions are
measured in longest steps (see `action_gap`), so that a bound means the same for every robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.collect.drivers import Generators, Setting, expert_actions, observations, policy_actions
from manip_il.collect.rollout import Environment, Labeller, Rules, Turn, rollout
from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import Actor, State, Transition
from manip_il.seeding import rng_for

F64 = NDArray[np.float64]
Gate = Callable[[Sequence[Turn], Sequence[F64]], Sequence[bool]]
"""Return whether the expert is queried in each turn, given the actions (n,) that the learner would execute."""
LabelMode = Literal["per_state", "takeover", "branch", "last"]
"""What the expert gives when it is queried.

`per_state`: its label. `takeover`: it drives to the end, for which it has a horizon of its own. `branch`: in a copy of
the simulator it drives some steps ahead. `last`: the label of the last state alone, for its phase.
"""
_STREAM = "ask"  # of random numbers; another name would draw other states


@dataclass(frozen=True)
class Query:
    """A rule that says when the expert is queried. bound: 0 for rules without one.

    Raises `UsageError` for a bound outside the rule's range.
    """

    bound: float = 0.0
    kind: ClassVar[str]
    words: ClassVar[str]  # for help and errors
    limits: ClassVar[tuple[float, float] | None] = None  # of the bound; None for a rule without one

    def __post_init__(self) -> None:
        if self.limits is None:
            return
        low, high = self.limits
        if not (math.isfinite(self.bound) and low <= self.bound <= high):
            raise UsageError(f"query is {self}; expected {self.words}")

    def __str__(self) -> str:
        return self.kind if self.limits is None else f"{self.kind}:{self.bound:g}"

    def start(self, setting: Setting) -> Gate:
        """Return the rule at work, for the episodes of one process."""
        raise NotImplementedError


class Every(Query):
    """Every state."""

    kind, words = "every", "in every state (Ross et al. 2011)"

    def start(self, setting: Setting) -> Gate:
        """Return the rule at work."""
        return lambda turns, actions: [True] * len(turns)


class One(Query):
    """One step of an episode, drawn evenly; of a takeover from the horizon, so never if the episode ends before."""

    kind, words = "one", "once an episode, at a drawn step (with one episode a round: Stagger, Li & Zhang 2025)"

    def start(self, setting: Setting) -> Gate:
        """Return the rule at work."""
        return lambda turns, actions: [turn.step == drawn_step(turn.seed, setting.horizon) for turn in turns]


class Probability(Query):
    """Each step with the same probability, drawn from the episode's own generator."""

    kind, limits = "probability", (math.ulp(0.0), 1.0)
    words = "probability:0.1, at each step by chance; more than 0, at most 1"

    def start(self, setting: Setting) -> Gate:
        """Return the rule at work."""
        rngs = Generators(_STREAM)
        return lambda turns, actions: [rngs[turn.seed].uniform() < self.bound for turn in turns]


class Ensemble(Query):
    """States where an ensemble's actions spread: root mean square distance to their mean, in the worst dimension."""

    kind, limits = "ensemble", (0.0, math.inf)
    words = "ensemble:0.2, where policies that differ by their seed disagree by more (Menda et al. 2019); 0 or more"

    def start(self, setting: Setting) -> Gate:
        """Return the rule at work."""
        if len(setting.policies) < 2:
            raise UsageError("query=ensemble needs other policies to disagree with")
        others = setting.policies[1:]

        def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> Sequence[bool]:
            answers = np.stack([np.stack(actions), *(policy_actions(policy, turns) for policy in others)])
            return ((answers.std(axis=0) / setting.actions.scale).max(axis=-1) > self.bound).tolist()

        return gate


class Likelihood(Query):
    """States where the learner finds its own action less likely than the bound [nats a dimension]."""

    kind, limits = "likelihood", (-math.inf, math.inf)
    words = "likelihood:-2, where the policy finds its own action less likely, in nats a joint; a finite number"

    def start(self, setting: Setting) -> Gate:
        """Return the rule at work. Raises `UsageError` for a policy without a likelihood."""
        learner = setting.policies[0]
        learner.require_likelihood()

        def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> Sequence[bool]:
            stacked = np.stack(actions)
            likelihood = learner.log_prob(*observations(turns, learner.cameras), stacked)
            return (likelihood / stacked.shape[1] < self.bound).tolist()

        return gate


class Safety(Query):
    """States where expert and learner differ by more than the bound.

    To know that, the expert labels every state; its label is kept where they differ.
    """

    kind, limits = "safety", (0.0, math.inf)
    words = "safety:0.5, where expert and learner differ by more (Zhang & Cho 2017); 0 or more"

    def start(self, setting: Setting) -> Gate:
        """Return the rule at work."""

        def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> Sequence[bool]:
            labels = [turn.label or turn.peek() for turn in turns]
            pairs = zip(labels, actions, strict=True)
            gaps = [action_gap(label.action, action, setting.actions.scale) for label, action in pairs]
            return [bool(gap > self.bound) for gap in gaps]

        return gate


QUERIES: dict[str, type[Query]] = {
    "every": Every,
    "one": One,
    "probability": Probability,
    "ensemble": Ensemble,
    "likelihood": Likelihood,
    "safety": Safety,
}


def parse_query(text: str) -> Query:
    """Return a rule as it is written; `UnknownName` for its kind, `UsageError` for a wrong or missing bound."""
    kind, colon, bound = text.partition(":")
    if kind not in QUERIES:
        raise UnknownName("query rule", kind, QUERIES)
    rule = QUERIES[kind]
    if rule.limits is None:
        if colon:
            raise UsageError(f"query is {text!r}; expected {kind} alone")
        return rule()
    try:
        return rule(float(bound))
    except ValueError:
        raise UsageError(f"query is {text!r}; expected {kind}:NUMBER ({rule.words})") from None


def gate_of(label: LabelMode, query: Query, setting: Setting) -> Gate:
    """Return when a rollout queries the expert; `one` waits for the end (`labelled`) unless the expert takes over."""
    if label == "last":
        return lambda turns, actions: [turn.step == setting.horizon - 1 for turn in turns]
    if isinstance(query, One) and label != "takeover":
        return lambda turns, actions: [False] * len(turns)
    return query.start(setting)


def labelled(frames: list[Transition], query: Query, expert: Labeller) -> list[Transition]:
    """Return an episode's frames, for `one` with the label of a step drawn from those that there are."""
    if isinstance(query, One):
        step = drawn_step(frames[0].seed, len(frames))
        frames[step] = replace(frames[step], label=expert.label(frames[step].state))
    return frames


def cut_at_takeover(frames: list[Transition], horizon: int) -> list[Transition]:
    """Return the learner's frames as a part that ends, and the expert's if it took over; no more than the horizon."""
    taken = next((i for i, frame in enumerate(frames) if frame.actor != Actor.LEARNER), None)
    if taken == 0:
        return frames
    last = min(len(frames) if taken is None else taken, horizon) - 1
    rest = [] if taken is None else frames[taken:]
    return [*frames[:last], replace(frames[last], done=True), *rest]


def branches(env: Environment, expert: Labeller, frames: Sequence[Transition], steps: int) -> Iterator[Transition]:
    """Yield what the expert does for some steps from every frame that has a valid label."""
    for frame in frames:
        if frame.label is not None and frame.label.valid:
            yield from branch(env, expert, frame.state, frame.seed, steps)


def branch(env: Environment, expert: Labeller, first: State, seed: int, steps: int) -> Iterator[Transition]:
    """Yield the expert's next steps from a state; the last one is `done`."""
    yield from rollout([env], [seed], expert_actions, Rules(steps), expert, first=first)


def action_gap(left: F64, right: F64, scale: F64) -> F64:
    """Return the largest difference over the dimensions of two actions (..., n), in units of `scale` (n,)."""
    return np.abs((left - right) / scale).max(axis=-1)


def drawn_step(seed: int, steps: int) -> int:
    """Return one step of `steps`, the same for the same episode."""
    return int(rng_for(seed, _STREAM).integers(steps))
