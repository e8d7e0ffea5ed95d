"""Processes small enough to be solved exactly, which differ in what one wrong step costs if the expert then drives.

A policy is an array (H, S): the probability of a wrong action at each step in each state. Several policies
are (..., H, S).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import F64, I64

PLACES = 100  # states that the expert visits
RIGHT, WRONG = 0, 1  # the expert's action in every state, and the other one
_BELOW_1 = 1 - 1e-9  # keeps a random number below 1 after rounding


@dataclass(frozen=True, eq=False)
class Process:
    """S states and two actions; the expert always takes `RIGHT`. Rewards are 0 to 1 per step.

    words: what a wrong action does. moves: transition probabilities (action, from, to), (2, S, S), uniform over the
    successors. rewards: (2, S). start: distribution of the first state, (S,). slopes: powers of the horizon with which
    gap over error grows according to the theorems, for cloning and for DAgger.
    """

    name: str
    words: str
    moves: F64
    rewards: F64
    start: F64
    slopes: tuple[float, float]

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.start)

    def wrong_costs(self, horizon: int) -> F64:
        """Return the cost of one wrong action at each step in each state if the expert then drives, (H, S)."""
        found, after = np.empty((horizon, self.states)), np.zeros(self.states)
        for t in range(horizon - 1, -1, -1):
            right, wrong = self.rewards + self.moves @ after
            found[t], after = right - wrong, right
        return found

    def recoverability(self, horizon: int) -> float:
        """Return u: the largest cost of one wrong action, over the states that some policy reaches."""
        uniform = np.full((horizon, self.states), 0.5)
        return float(self.wrong_costs(horizon)[self.visits(uniform) > 0].max())

    def visits(self, policy: F64) -> F64:
        """Return the distribution of the state at each step, (..., H, S), under policies (..., H, S)."""
        found = np.empty(policy.shape)
        now = np.broadcast_to(self.start, (*policy.shape[:-2], self.states))
        for t in range(policy.shape[-2]):
            found[..., t, :] = now
            wrong = now * policy[..., t, :]
            now = (now - wrong) @ self.moves[RIGHT] + wrong @ self.moves[WRONG]
        return found

    @cached_property
    def _successors(self) -> tuple[I64, I64]:
        """The states that an action may lead to, (2, S, K), and their number, (2, S)."""
        counts = (self.moves > 0).sum(axis=2)
        leads = np.zeros((2, self.states, counts.max()), np.int64)
        for action, state in np.ndindex(2, self.states):
            leads[action, state, : counts[action, state]] = np.flatnonzero(self.moves[action, state])
        return leads, counts

    def seen(self, policy: F64, count: int, rngs: list[np.random.Generator]) -> NDArray[np.bool_]:
        """Return whether any of `count` trajectories of each policy (B, H, S) visits a state at a step, (B, H, S).

        rngs: one for each policy.
        """
        (leads, counts), (batch, horizon, _) = self._successors, policy.shape
        now = np.stack([rng.choice(self.states, count, p=self.start) for rng in rngs])
        chances = np.stack([rng.random((horizon, 2, count)) for rng in rngs])
        found, rows = np.zeros(policy.shape, np.bool_), np.arange(batch)[:, None]
        for t in range(horizon):
            found[rows, t, now] = True
            action = (1 - policy[rows, t, now] <= chances[:, t, 0]).astype(np.int64)
            way = chances[:, t, 1] * _BELOW_1 * counts[action, now]
            now = leads[action, now, way.astype(np.int64)]
        return found


def _walk(back: bool) -> tuple[F64, F64, F64]:
    """A random walk over `PLACES` states, and one state beside them that a wrong action leads to.

    back: whether the right action leads back from there.
    """
    moves = np.zeros((2, PLACES + 1, PLACES + 1))
    rewards = np.zeros((2, PLACES + 1))
    beside = PLACES
    moves[RIGHT, :PLACES, :PLACES] = 1 / PLACES
    moves[WRONG, :, beside] = 1.0
    moves[RIGHT, beside, :PLACES] = back / PLACES
    moves[RIGHT, beside, beside] = not back
    rewards[RIGHT, :PLACES] = 1.0
    return moves, rewards, np.append(np.full(PLACES, 1 / PLACES), 0.0)


def _ring() -> tuple[F64, F64, F64]:
    """A ring of `PLACES` states, all visited by the expert: right actions move 1 or 2 forward, wrong ones back."""
    on = (np.roll(np.eye(PLACES), 1, axis=1) + np.roll(np.eye(PLACES), 2, axis=1)) / 2
    rewards = np.stack([np.ones(PLACES), np.zeros(PLACES)])
    return np.stack([on, on.T]), rewards, np.full(PLACES, 1 / PLACES)


PROCESSES = (
    Process("mended walk", "leads off the path, to which the expert returns in one step", *_walk(True), (2, 1)),
    Process("tightrope", "is a fall without recovery", *_walk(False), (2, 2)),
    Process("visited chain", "leads to another state that the expert visits", *_ring(), (1, 1)),
)
