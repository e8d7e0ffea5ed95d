"""Processes small enough to be solved, told apart by what one wrong step costs an expert who drives on.

A policy is the probability (H, S) with which it acts wrongly, at each step in each state; several are (..., H, S).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

F64, I64 = NDArray[np.float64], NDArray[np.int64]
PLACES = 100  # states that the expert is in
RIGHT, WRONG = 0, 1  # the expert's action everywhere, and the other one
_BELOW_1 = 1 - 1e-9  # of the chances that are drawn


@dataclass(frozen=True, eq=False)
class Process:
    """S states and two actions, of which the expert always takes `RIGHT`, for rewards of 0 to 1 a step.

    words: what a wrong action does. moves: where each action leads, (2, S, S), evenly to some states. rewards: (2, S).
    start: distribution of the first state, (S,). slopes: powers of the horizon with which the gap over the policy's own
    error grows, of cloning and of DAgger, as the theorems have it.
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

    @cache  # noqa: B019  (three processes, which live as long as the program)
    def wrong_costs(self, horizon: int) -> F64:
        """Return what one wrong action costs in each state and step, the expert driving on, (H, S)."""
        found, after = np.empty((horizon, self.states)), np.zeros(self.states)
        for t in range(horizon - 1, -1, -1):
            right, wrong = self.rewards + self.moves @ after
            found[t], after = right - wrong, right
        return found

    @cache  # noqa: B019
    def recoverability(self, horizon: int) -> float:
        """Return u: the most that one wrong action costs, in states that some policy gets to."""
        anyhow = np.full((horizon, self.states), 0.5)
        return float(self.wrong_costs(horizon)[self.visits(anyhow) > 0].max())

    @cache  # noqa: B019
    def expert_visits(self, horizon: int) -> F64:
        """Return the distribution of the expert's state at each step, (H, S)."""
        return self.visits(np.zeros((horizon, self.states)))

    def visits(self, policy: F64) -> F64:
        """Return the distribution of the state at each step under policies (..., H, S), (..., H, S)."""
        found = np.empty(policy.shape)
        now = np.broadcast_to(self.start, (*policy.shape[:-2], self.states))
        for t in range(policy.shape[-2]):
            found[..., t, :] = now
            wrong = now * policy[..., t, :]
            now = (now - wrong) @ self.moves[RIGHT] + wrong @ self.moves[WRONG]
        return found

    @cached_property
    def _ways(self) -> tuple[I64, I64]:
        """The states that an action may lead to (2, S, K), and how many they are (2, S)."""
        counts = (self.moves > 0).sum(axis=2)
        leads = np.zeros((2, self.states, counts.max()), np.int64)
        for action, state in np.ndindex(2, self.states):
            leads[action, state, : counts[action, state]] = np.flatnonzero(self.moves[action, state])
        return leads, counts

    def seen(self, policy: F64, count: int, rngs: list[np.random.Generator]) -> NDArray[np.bool_]:
        """Return whether one of `count` trajectories of each policy (B, H, S) is in a state at a step, (B, H, S).

        rngs: one for each policy.
        """
        (leads, counts), (batch, horizon, _) = self._ways, policy.shape
        now = np.stack([rng.choice(self.states, count, p=self.start) for rng in rngs])
        chances = np.stack([rng.random((horizon, 2, count)) for rng in rngs])
        found, rows = np.zeros(policy.shape, np.bool_), np.arange(batch)[:, None]
        for t in range(horizon):
            found[rows, t, now] = True
            action = (1 - policy[rows, t, now] <= chances[:, t, 0]).astype(np.int64)
            way = chances[:, t, 1] * _BELOW_1 * counts[action, now]
            now = leads[action, now, way.astype(np.int64)]
        return found


def _beside(back: bool) -> tuple[F64, F64, F64]:
    """`PLACES` that follow on each other by chance, and one beside them that a wrong action leads to.

    back: whether the right action leads back from there.
    """
    moves, rewards, beside = np.zeros((2, PLACES + 1, PLACES + 1)), np.zeros((2, PLACES + 1)), PLACES
    moves[RIGHT, :PLACES, :PLACES] = 1 / PLACES
    moves[WRONG, :, beside] = 1.0
    moves[RIGHT, beside, :PLACES] = back / PLACES
    moves[RIGHT, beside, beside] = not back
    rewards[RIGHT, :PLACES] = 1.0
    return moves, rewards, np.append(np.full(PLACES, 1 / PLACES), 0.0)


def _ring() -> tuple[F64, F64, F64]:
    """`PLACES` in a ring: the right action leads one or two on, the wrong one back; the expert is in all of them."""
    on = (np.roll(np.eye(PLACES), 1, axis=1) + np.roll(np.eye(PLACES), 2, axis=1)) / 2
    rewards = np.stack([np.ones(PLACES), np.zeros(PLACES)])
    return np.stack([on, on.T]), rewards, np.full(PLACES, 1 / PLACES)


PROCESSES = (
    Process("mended walk", "leads off the way, from where the expert is back in one step", *_beside(True), (2, 1)),
    Process("tightrope", "is a fall that nothing mends", *_beside(False), (2, 2)),
    Process("visited chain", "leads to another state that the expert visits", *_ring(), (1, 1)),
)
