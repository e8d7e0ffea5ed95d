"""The only loop that steps environments, as a generator of transitions.

Environments run in lockstep, so that a learner acts in all of them in one batch. Recording,
labelling and evaluation consume its transitions and are not branches inside it. In this loop only
`_choose` queries the expert.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from manip_il.errors import ManipError
from manip_il.mdp import F64, Actor, Label, Observation, State, Transition
from manip_il.worlds.contract import Environment, Expert

GROWTH = 0.01  # smallest increase of a task's progress, in [0, 1], that counts


@dataclass(slots=True)
class Turn:
    """One running episode at one step, as a driver sees it.

    Attributes:
        seed: Seed of the episode.
        step: Number of the control step, from 0.
        observation: What a policy observes.
        state: State in which the action is chosen.
        expert: The expert that can be queried; None if there is none.
        label: The expert's label; None if the expert was not queried.
        progress: Share of the task that is done, 0 to 1.
        environment: The episode's environment, which is in this state until the turn ends.
    """

    seed: int
    step: int
    observation: Observation
    state: State
    expert: Expert | None = None
    label: Label | None = None
    progress: float = 0.0
    environment: Environment | None = None

    def query(self) -> Label:
        """Return the expert's label of this state and keep it.

        Raises `ManipError` if there is no expert.
        """
        if self.label is None:
            self.label = self.peek()
        return self.label

    def peek(self) -> Label:
        """Return the expert's label of this state without keeping it."""
        if self.expert is None:
            raise ManipError(
                f"episode {self.seed}: there is no expert to query at step {self.step}"
            )
        return self.expert.label(self.state, self.environment)


Act = Callable[[Sequence[Turn]], list[tuple[F64, Actor]]]
"""A started driver: returns an action (n,) and its actor for every turn of a step."""
Gate = Callable[[Sequence[Turn], Sequence[F64]], Sequence[bool]]
"""A started query rule: returns whether the expert is queried in each turn, given the actions (n,)
that would be executed.
"""


@dataclass(frozen=True)
class Rules:
    """When an episode ends.

    Attributes:
        horizon: Largest number of control steps.
        hold: Control steps for which an episode continues after success; None: it continues to the
            horizon.
        patience: Control steps without progress after which an episode also ends; None: it never
            does so.
        takeover: Whether the expert, once queried, drives to the end. It may then take `horizon`
            steps more than the learner alone has.
    """

    horizon: int
    hold: int | None = None
    patience: int | None = None
    takeover: bool = False


@dataclass(slots=True)
class _Slot:
    env: Environment
    seed: int
    step: int = 0
    since_solved: int = 0  # control steps, with the one that solved it
    best: float = -math.inf
    since: int = 0
    taken_over: bool = False
    turn: Turn = field(init=False)
    chosen: tuple[F64, Actor] = field(init=False)

    def is_stuck(self, patience: int) -> bool:
        """Return whether progress has not grown by `GROWTH` for `patience` steps."""
        if self.turn.progress >= self.best + GROWTH:
            self.best, self.since = self.turn.progress, self.step
        return self.step - self.since >= patience


def rollout(
    envs: Sequence[Environment],
    seeds: Iterable[int],
    act: Act,
    rules: Rules,
    expert: Expert,
    gate: Gate | None = None,
    *,
    first: State | None = None,
) -> Iterator[Transition]:
    """Run one episode per seed, `len(envs)` at a time, and yield the transition of every step.

    An environment whose episode ends takes the next seed. An episode depends on its seed alone, not
    on other episodes.

    Args:
        envs: Environments that run in lockstep.
        seeds: One for each episode.
        act: Chooses the actions of all running episodes in a step.
        rules: When an episode ends.
        expert: Labels the states in which it is queried.
        gate: When to query the expert; None: only if `act` does.
        first: Start state of every episode; None: it is drawn by seed.
    """
    waiting = iter(seeds)
    running = [slot for env in envs if (slot := _next_episode(env, waiting, first)) is not None]
    while running:
        for slot in running:
            _observe(slot, expert)
        _choose(running, act, gate, rules.takeover)
        still: list[_Slot] = []
        for slot in running:
            transition = _advance(slot, rules)
            yield transition
            following = _next_episode(slot.env, waiting, first) if transition.done else slot
            if following is not None:
                still.append(following)
        running = still


def _next_episode(env: Environment, seeds: Iterator[int], first: State | None) -> _Slot | None:
    seed = next(seeds, None)
    if seed is None:
        return None
    if first is None:
        env.start(seed)
    else:
        env.set_state(first)
    return _Slot(env, seed)


def _observe(slot: _Slot, expert: Expert) -> None:
    env = slot.env
    seen, state = env.observe(), env.get_state()
    slot.turn = Turn(
        slot.seed, slot.step, seen, state, expert, progress=env.progress, environment=env
    )


def _choose(running: Sequence[_Slot], act: Act, gate: Gate | None, takeover: bool) -> None:
    """Choose every episode's action, and query the expert in the episodes that the gate selects."""
    led = [slot for slot in running if not slot.taken_over]
    turns = [slot.turn for slot in led]
    chosen = act(turns) if led else []
    wanted = gate(turns, [action for action, _ in chosen]) if led and gate else [False] * len(led)
    for slot, choice, wants in zip(led, chosen, wanted, strict=True):
        slot.chosen = choice
        if wants:
            slot.turn.query()
            slot.taken_over = takeover
    for slot in running:
        if slot.taken_over:
            slot.chosen = slot.turn.query().action, Actor.EXPERT


def _advance(slot: _Slot, rules: Rules) -> Transition:
    action, actor = slot.chosen
    outcome = slot.env.step(action)
    if actor == Actor.EXPERT and outcome.executed is not action:
        actor = Actor.NOISY_EXPERT
    slot.step += 1
    if outcome.solved or slot.since_solved:
        slot.since_solved += 1
    horizon = 2 * rules.horizon if slot.taken_over else rules.horizon
    has_ended = rules.hold is not None and slot.since_solved > rules.hold
    gives_up = (
        rules.patience is not None and not slot.since_solved and slot.is_stuck(rules.patience)
    )
    return Transition(
        seed=slot.seed,
        step=slot.step - 1,
        state=slot.turn.state,
        observation=slot.turn.observation,
        label=slot.turn.label,
        executed_action=outcome.executed,
        actor=actor,
        reward=outcome.reward,
        success=outcome.solved,
        done=slot.step >= horizon or outcome.ended or has_ended or gives_up,
        progress=slot.turn.progress,
    )
