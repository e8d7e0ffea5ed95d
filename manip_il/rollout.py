"""The one loop that steps environments, as a generator of transitions.

Environments run in lockstep, so that a learner answers for all of them in one batch. Recording, labelling and
evaluation are consumers of what it yields, not branches inside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.mdp import Actor, Label, Observation, State, Transition

F64 = NDArray[np.float64]


class Environment(Protocol):
    """An environment as the loop needs it."""

    @property
    def solved(self) -> bool:
        """Whether the task is solved now."""
        ...

    @property
    def progress(self) -> float:
        """Share of the task that is done, 0 to 1."""
        ...

    def start(self, seed: int) -> None:
        """Begin the episode of a seed."""
        ...

    def advance(self, action: F64) -> None:
        """Apply an action (n,) for one control step."""
        ...

    def observe(self) -> Observation:
        """Return what a learner sees now."""
        ...

    def get_state(self) -> State:
        """Return everything that the future depends on."""
        ...


class Labeller(Protocol):
    """Answers what the expert would do."""

    def label(self, state: State) -> Label:
        """Return the expert's action in `state`."""
        ...


class Driver(Protocol):
    """Chooses the executed action of every running episode."""

    def act(self, turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        """Return an action (n,) and who chose it, for every turn."""
        ...


class Intruder(Protocol):
    """Disturbs one episode: before a step in the environment, or in the action on its way to the robot."""

    def before(self, step: int) -> None:
        """Apply what happens before the state of `step` is read."""
        ...

    def action(self, action: F64) -> F64:
        """Return the action as it reaches the robot, (n,)."""
        ...


@dataclass(slots=True)
class Turn:
    """One running episode at one step, as a driver sees it. `label` is None where nobody asked for it."""

    seed: int
    step: int
    observation: Observation
    state: State
    labeller: Labeller | None = None
    label: Label | None = None
    progress: float = 0.0

    def ask(self) -> Label:
        """Return the expert's label of this state, from now on the turn's.

        Raises `ManipError` where there is no expert.
        """
        if self.label is None:
            self.label = self.peek()
        return self.label

    def peek(self) -> Label:
        """Return what `ask` gives, without keeping it."""
        if self.labeller is None:
            raise ManipError(f"episode {self.seed}: nobody to ask for a label at step {self.step}")
        return self.labeller.label(self.state)


@dataclass(frozen=True)
class Rules:
    """Length of an episode, and the states in which the expert is queried.

    horizon: control steps at most. hold: go on for this many steps once solved, then end; None: to the horizon.
    query: in every state, in the last one only, or only where the driver asks.
    """

    horizon: int
    hold: int | None = None
    query: Literal["every", "last", "driver"] = "every"


@dataclass(slots=True)
class _Slot:
    env: Environment
    seed: int
    intruder: Intruder | None
    step: int = 0
    held: int = 0
    turn: Turn = field(init=False)


def rollout(
    envs: Sequence[Environment],
    seeds: Iterable[int],
    driver: Driver,
    rules: Rules,
    labeller: Labeller | None = None,
    intrude: Callable[[Environment, int], Intruder | None] | None = None,
) -> Iterator[Transition]:
    """Run one episode per seed, `len(envs)` at a time; yields every step's transition as it happens.

    An environment whose episode ends takes the next seed. What an episode holds depends on its seed alone,
    not on its neighbours. intrude: makes an episode's disturbances, or None for none.
    """
    waiting = iter(seeds)
    running = [slot for env in envs if (slot := _next_episode(env, waiting, intrude)) is not None]
    while running:
        for slot in running:
            _look(slot, rules, labeller)
        actions = driver.act([slot.turn for slot in running])
        still: list[_Slot] = []
        for slot, (action, actor) in zip(running, actions, strict=True):
            transition = _advance(slot, action, actor, rules)
            yield transition
            following = _next_episode(slot.env, waiting, intrude) if transition.done else slot
            if following is not None:
                still.append(following)
        running = still


def _next_episode(
    env: Environment,
    seeds: Iterator[int],
    intrude: Callable[[Environment, int], Intruder | None] | None,
) -> _Slot | None:
    seed = next(seeds, None)
    if seed is None:
        return None
    env.start(seed)
    return _Slot(env, seed, intrude(env, seed) if intrude is not None else None)


def _look(slot: _Slot, rules: Rules, labeller: Labeller | None) -> None:
    if slot.intruder is not None:
        slot.intruder.before(slot.step)
    env = slot.env
    slot.turn = Turn(slot.seed, slot.step, env.observe(), env.get_state(), labeller, progress=env.progress)
    last = slot.step == rules.horizon - 1
    if labeller is not None and (rules.query == "every" or (rules.query == "last" and last)):
        slot.turn.ask()


def _advance(slot: _Slot, action: F64, actor: Actor, rules: Rules) -> Transition:
    executed = slot.intruder.action(action) if slot.intruder is not None else action
    if actor == Actor.EXPERT and executed is not action:
        actor = Actor.NOISY_EXPERT
    slot.env.advance(executed)
    slot.step += 1
    solved = slot.env.solved
    slot.held += slot.held > 0 or solved
    done = slot.step >= rules.horizon or (rules.hold is not None and slot.held > rules.hold)
    return Transition(
        seed=slot.seed,
        step=slot.step - 1,
        state=slot.turn.state,
        observation=slot.turn.observation,
        label=slot.turn.label,
        executed_action=executed,
        actor=actor,
        reward=float(solved),
        success=solved,
        done=done,
        progress=slot.turn.progress,
        final=slot.env.observe() if done else None,
    )
