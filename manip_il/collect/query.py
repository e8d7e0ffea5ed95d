"""When the expert is queried, and what it returns.

A rule is written `kind` or `kind:bound`, as in `every`, `one`, `probability:0.1` or `safety:0.5`.
`rollout` applies it in every step to the learner's actions; `labelled` applies `one` after the
episode. Differences between actions are divided by each dimension's longest step, and the largest
quotient is compared with the bound, so that a bound means the same for every robot.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from manip_il.collect.drivers import Setting, expert_actions, generators, policy_actions
from manip_il.collect.rollout import Gate, Rules, Turn, rollout
from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import F64, Actor, State, Transition
from manip_il.seeding import rng_for
from manip_il.worlds.contract import Environment, Expert

LabelMode = Literal["per_state", "takeover", "branch", "last"]
"""What the expert returns when it is queried.

`per_state`: its label. `takeover`: the expert drives to the end, with its own horizon. `branch`:
the expert drives some steps in a copy of the simulator. `last`: only the label of the last state,
which tells the phase reached.
"""
_MOST = 1e6  # largest bound
_STREAM = "ask"  # random stream; another name would draw other states


@dataclass(frozen=True)
class Query:
    """A rule for when the expert is queried.

    Attributes:
        kind: One of `RULES`.
        bound: The rule's bound; None for rules without one.

    Raises:
        UnknownName: for an unknown kind.
        UsageError: for a bound outside the rule's range.
    """

    kind: str = "every"
    bound: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in RULES:
            raise UnknownName("query rule", self.kind, RULES)
        _, limits = RULES[self.kind]
        if limits is None:
            if self.bound is not None:
                raise UsageError(f"query is {self}; expected {self.kind} alone")
        elif self.bound is None or not limits[0] <= self.bound <= limits[1]:
            low, high = limits
            raise UsageError(
                f"query is {self}; expected {self.kind}:NUMBER, from {low:g} to {high:g}"
            )

    def __str__(self) -> str:
        return self.kind if self.bound is None else f"{self.kind}:{self.bound:g}"

    def start(self, setting: Setting) -> Gate:
        """Return the rule for the episodes of one process.

        Raises `UsageError` if `setting` has too few policies.
        """
        rule, _ = RULES[self.kind]
        return rule(self.bound or 0.0, setting)


def _every(bound: float, setting: Setting) -> Gate:
    """Query in every state (Ross et al. 2011)."""
    return lambda turns, actions: [True] * len(turns)


def _one(bound: float, setting: Setting) -> Gate:
    """Query once per episode, at a uniformly drawn step (with one episode per round: Stagger, Li &
    Zhang 2025).

    For a takeover the step is drawn from the horizon, so an episode that ends earlier has no query.
    """
    return lambda turns, actions: [
        turn.step == drawn_step(turn.seed, setting.horizon) for turn in turns
    ]


def _probability(bound: float, setting: Setting) -> Gate:
    """Query at each step with a probability equal to the bound."""
    rngs = generators(_STREAM)
    return lambda turns, actions: [rngs(turn.seed).uniform() < bound for turn in turns]


def _ensemble(bound: float, setting: Setting) -> Gate:
    """Query if policies that differ by their seed disagree by more than the bound: the measure of
    EnsembleDAgger (Menda et al. 2019), which decides by it who drives.

    Disagreement is the root mean square distance of their actions from the mean, in the worst
    dimension.
    """
    if len(setting.policies) < 2:
        raise UsageError("query=ensemble needs at least two policies")
    others = setting.policies[1:]

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> Sequence[bool]:
        answers = np.stack(
            [np.stack(actions), *(policy_actions(policy, turns) for policy in others)]
        )
        return ((answers.std(axis=0) / setting.actions.scale).max(axis=-1) > bound).tolist()

    return gate


def _safety(bound: float, setting: Setting) -> Gate:
    """Query if expert and learner differ by more than the bound: the measure of SafeDAgger (Zhang &
    Cho 2017), which decides by it who drives.

    The expert labels every state for this comparison; the label is kept only if they differ that
    much.
    """

    def gate(turns: Sequence[Turn], actions: Sequence[F64]) -> Sequence[bool]:
        labels = [turn.label or turn.peek() for turn in turns]
        pairs = zip(labels, actions, strict=True)
        return [
            bool(np.abs((one.action - action) / setting.actions.scale).max() > bound)
            for one, action in pairs
        ]

    return gate


# kind -> rule, bound limits
RULES: dict[str, tuple[Callable[[float, Setting], Gate], tuple[float, float] | None]] = {
    "every": (_every, None),
    "one": (_one, None),
    "probability": (_probability, (1e-6, 1.0)),
    "ensemble": (_ensemble, (0.0, _MOST)),
    "safety": (_safety, (0.0, _MOST)),
}


def parse_query(text: str) -> Query:
    """Parse a rule.

    Raises `UnknownName` for an unknown kind, `UsageError` for an invalid or missing bound.
    """
    kind, colon, bound = text.partition(":")
    try:
        return Query(kind, float(bound) if colon else None)
    except ValueError:
        raise UsageError(f"query is {text!r}; expected {kind}:NUMBER") from None


def gate_of(label: LabelMode, query: Query, setting: Setting) -> Gate:
    """Return the rule by which a rollout queries the expert.

    For `one` without takeover this rule never queries: `labelled` labels the drawn step when the
    episode is over.

    Args:
        label: What the expert returns; with `last` it is queried only in the last step before the
            horizon.
        query: The rule for all other labels.
        setting: What the rule knows about its rollouts.

    Returns:
        The started rule, for the episodes of one process.

    Raises:
        UsageError: if `setting` has too few policies for the rule.
    """
    if label == "last":
        return lambda turns, actions: [turn.step == setting.horizon - 1 for turn in turns]
    if query.kind == "one" and label != "takeover":
        return lambda turns, actions: [False] * len(turns)
    return query.start(setting)


def labelled(frames: list[Transition], query: Query, expert: Expert) -> list[Transition]:
    """Have the expert label one random step of an episode if the query is `one`.

    Args:
        frames: The episode's frames; the list is changed in place.
        query: The rule by which the episode was recorded.
        expert: Labels the drawn step.

    Returns:
        The same list of frames.
    """
    if query.kind == "one":
        step = drawn_step(frames[0].seed, len(frames))
        frames[step] = replace(frames[step], label=expert.label(frames[step].state))
    return frames


def cut_at_takeover(frames: list[Transition]) -> tuple[list[Transition], int]:
    """Return an episode's frames, the learner's last one also `done`, and the number of the
    learner's frames.
    """
    own = next((i for i, frame in enumerate(frames) if frame.actor != Actor.LEARNER), len(frames))
    if own > 0:
        frames = [*frames[: own - 1], replace(frames[own - 1], done=True), *frames[own:]]
    return frames, own


def branch(
    env: Environment, expert: Expert, first: State, seed: int, steps: int
) -> Iterator[Transition]:
    """Yield the expert's next steps from a state; the last one is `done`.

    Args:
        env: The environment in which the expert drives; its own state is lost.
        expert: Chooses and labels every action.
        first: The state in which the branch begins.
        seed: Seed of the yielded transitions.
        steps: Number of control steps.
    """
    yield from rollout([env], [seed], expert_actions, Rules(steps), expert, first=first)


def drawn_step(seed: int, steps: int) -> int:
    """Return a random step below `steps`, which depends only on `steps` and the episode's seed."""
    return int(rng_for(seed, _STREAM).integers(steps))
