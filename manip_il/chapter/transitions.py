"""Transitions of episodes of equal length: the discriminators' samples of demonstrations and of the learner.

Learning needs episodes of equal length H: if an episode that succeeds ends early, a reward that is positive (or
negative) everywhere rewards (or punishes) staying alive, whatever was demonstrated (Kostrikov et al., Discriminator-
actor-critic, ICLR 2019, section 4.2; Orsini et al., What matters for adversarial imitation learning?, NeurIPS 2021,
section 4). So an episode that has ended continues in an absorbing state, marked by a flag, until step H.
Demonstrations are padded in the same way.

An episode ends `hold` steps after success, as the demonstrations do. It must not continue at the goal instead:
nobody demonstrated how to stay there for long, so the learner's many states there would look unlike the demonstrations'
few, and arriving late would pay off. The learner spends the same share of time in the absorbing state as the
demonstrations if and only if it arrives as fast as they do.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data.dataset import joined_columns
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.data.schema import ACTION, ACTOR, ENVIRONMENT_STATE, LABEL_VALID, STATE, SUCCESS
from manip_il.errors import NothingToLearnError, UsageError
from manip_il.learn.samples import Table
from manip_il.mdp import F32, Actor, require_finite


@dataclass(frozen=True, eq=False)
class Transitions:
    """Steps of episodes, N rows. states, next_states: (N, d + 1), raw inputs and the flag of the absorbing state.

    actions: (N, n), normalised as for the policy's head, clipped to their range.
    """

    states: F32
    actions: F32
    next_states: F32

    def __len__(self) -> int:
        return len(self.states)

    @property
    def absorbing(self) -> NDArray[np.bool_]:
        """Whether each row's state is absorbing, (N,)."""
        return self.states[:, -1] > 0


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """Whole episodes of the expert: raw inputs (T, d) and targets (T, n) of each, in a policy's action space.

    hold: steps from success to the end; None for episodes that do not end, as in a benchmark's environments.
    """

    inputs: tuple[F32, ...]
    targets: tuple[F32, ...]
    hold: int | None

    @property
    def longest(self) -> int:
        """Number of frames in the longest episode."""
        return max(map(len, self.inputs))

    @cached_property
    def stacked(self) -> tuple[F32, F32]:
        """Return all inputs (N, d) and targets (N, n), raw."""
        return np.concatenate(self.inputs), np.concatenate(self.targets)

    def padded(self, steps: int, encode: Callable[[F32], F32]) -> Transitions:
        """Return all episodes, each padded to `steps` transitions, or not padded if `hold` is None.

        encode: normalises raw targets (T, n). Raises `UsageError` if an episode is longer than `steps`.
        """
        if self.longest > steps:
            raise UsageError(
                f"episode_steps is {steps}; expected at least {self.longest}, the steps of the longest demonstration"
            )
        made = [
            padded_episode(inputs, encode(targets), 0 if self.hold is None else steps)
            for inputs, targets in zip(self.inputs, self.targets, strict=True)
        ]
        return Transitions(*(np.concatenate(parts) for parts in zip(*made, strict=True)))


def padded_episode(inputs: F32, actions: F32, steps: int) -> tuple[F32, F32, F32]:
    """Return states (N, d + 1), actions (N, n) and next states (N, d + 1) of an episode with T steps that ended.

    N is the larger of T and `steps`; rows after the end are absorbing. `steps` 0: the episode did not end; N is T - 1.
    """
    states = np.pad(inputs, ((0, 0), (0, 1)))
    if not steps:
        return states[:-1], actions[:-1], states[1:]
    rest = np.zeros((max(1, steps - len(states) + 1), states.shape[1]), np.float32)
    rest[:, -1] = 1.0
    states = np.concatenate([states, rest])
    actions = np.pad(actions, ((0, len(states) - 1 - len(actions)), (0, 0)))
    return states[:-1], actions, states[1:]


def read_demonstrations(
    roots: Sequence[Path], encode: Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]
) -> Demonstrations:
    """Read the expert's whole episodes from datasets. encode: `Conversion.encode` for actions (T, n), states (T, n).

    Skips episodes in which a learner drove at some step or a label is invalid, and those that failed. Raises
    `NothingToLearnError` if none is left, `NotFiniteError`, and what `joined_columns` raises.
    """
    table = joined_columns(roots, [STATE, ENVIRONMENT_STATE, ACTION, EPISODE_INDEX, LABEL_VALID, ACTOR, SUCCESS])
    for name in (STATE, ENVIRONMENT_STATE, ACTION):
        require_finite(f"column {name}", table[name])
    pieces = _episodes(table)
    kept = [piece for piece in pieces if _is_demonstration(table, piece)]
    if not kept:
        raise NothingToLearnError(
            f"none of the {len(pieces)} episodes in {', '.join(map(str, roots))} is the expert's and successful; "
            "record demonstrations with manip-il record"
        )
    inputs = np.concatenate([table[STATE], table[ENVIRONMENT_STATE]], axis=1).astype(np.float32)
    targets = [encode(table[ACTION][piece], table[STATE][piece]).astype(np.float32) for piece in kept]
    solved = table[SUCCESS].reshape(-1) != 0
    hold = min(len(solved[piece]) - 1 - int(np.argmax(solved[piece])) for piece in kept)
    return Demonstrations(tuple(inputs[piece] for piece in kept), tuple(targets), hold)


def _episodes(table: Table) -> list[slice]:
    """Return the rows of every episode."""
    bounds = np.flatnonzero(np.diff(np.asarray(table[EPISODE_INDEX]).reshape(-1), prepend=-1, append=-1))
    return [slice(*pair) for pair in itertools.pairwise(bounds)]


def _is_demonstration(table: Table, piece: slice) -> bool:
    """Return whether an episode is the expert's, valid and successful."""
    valid, driven = (table[LABEL_VALID][piece] != 0).all(), (table[ACTOR][piece] == Actor.EXPERT).all()
    return bool(valid and driven and (table[SUCCESS][piece] != 0).any())
