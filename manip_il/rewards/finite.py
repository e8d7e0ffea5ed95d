"""Finite Markov decision processes over a horizon, solved exactly by dynamic programming: nothing is sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from manip_il.errors import ManipError, MismatchError

F64, I64 = NDArray[np.float64], NDArray[np.int64]
_NEAR = 1e-9  # that probabilities may miss 1 by


@dataclass(frozen=True)
class FiniteMDP:
    """S states and A actions.

    transitions: sparse (S A, S); row s A + a is where action a leads from state s. rewards: (S, A). start: distribution
    of the first state, (S,). Raises `MismatchError` for shapes that do not fit, `ManipError` for what is no
    distribution or not finite.
    """

    transitions: Any
    rewards: F64
    start: F64

    def __post_init__(self) -> None:
        states, actions = self.rewards.shape
        if self.transitions.shape != (states * actions, states):
            expected = (states * actions, states)
            raise MismatchError("shape", "transitions", self.transitions.shape, "the rewards", expected)
        if self.start.shape != (states,):
            raise MismatchError("shape", "start", self.start.shape, "the rewards", (states,))
        sums = np.append(self.transitions.sum(axis=1), self.start.sum())
        least = min(self.transitions.data.min(initial=0.0), self.start.min())
        if least < 0 or np.abs(sums - 1).max() > _NEAR:
            raise ManipError("transitions or start are no distributions: probabilities below 0, or not 1 in all")
        if not np.isfinite(self.rewards).all():
            raise ManipError("a reward is not finite")

    @classmethod
    def of(cls, transitions: F64, rewards: F64, start: F64) -> FiniteMDP:
        """Return the process of dense transitions (S, A, S)."""
        return cls(csr_array(transitions.reshape(-1, transitions.shape[2])), rewards, start)

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.rewards)

    def action_values(self, after: F64) -> F64:
        """Return what each action is worth, (S, A), where the states it leads to are worth `after` (S,)."""
        return self.rewards + (self.transitions @ after).reshape(self.rewards.shape)

    def values(self, policy: F64) -> F64:
        """Return what every state is worth at each step to a policy (H, S, A), the end included: (H + 1, S)."""
        found = np.zeros((len(policy) + 1, self.states))
        for t in range(len(policy) - 1, -1, -1):
            found[t] = (policy[t] * self.action_values(found[t + 1])).sum(axis=1)
        return found

    def gaps(self, policy: F64) -> F64:
        """Return what each action costs a policy (H, S, A) that goes on after it, (H, S, A): V(s) - Q(s, a)."""
        values = self.values(policy)
        return np.stack([values[t][:, None] - self.action_values(values[t + 1]) for t in range(len(policy))])

    def visits(self, policy: F64) -> F64:
        """Return the distribution of the state at each step under a policy (H, S, A), (H, S)."""
        found, now, arrivals = np.empty((len(policy), self.states)), self.start, self.transitions.T
        for t, one in enumerate(policy):
            found[t] = now
            now = arrivals @ (now[:, None] * one).ravel()
        return found

    def worth(self, policy: F64) -> float:
        """Return the expected sum of rewards of a policy (H, S, A)."""
        return float(self.start @ self.values(policy)[0])

    def plan(self, horizon: int) -> I64:
        """Return the best action of every step and state, (H, S), the first of equals."""
        found, after = np.empty((horizon, self.states), np.int64), np.zeros(self.states)
        for t in range(horizon - 1, -1, -1):
            worth = self.action_values(after)
            found[t], after = worth.argmax(axis=1), worth.max(axis=1)
        return found


def deterministic(actions: I64, count: int) -> F64:
    """Return the policy (H, S, A) that takes actions (H, S) of `count`."""
    return np.eye(count)[actions]


class Trajectories:
    """Draws trajectories of a process, all at once."""

    def __init__(self, mdp: FiniteMDP):
        moves: Any = csr_array(mdp.transitions)
        rows = np.repeat(np.arange(moves.shape[0]), np.diff(moves.indptr))
        before = np.append(0.0, np.cumsum(moves.data))[moves.indptr[:-1]]
        self._mdp, self._to = mdp, moves.indices
        self._reach = rows + np.cumsum(moves.data) - before[rows]  # row + probability up to an entry: increases

    def states(self, policy: F64, count: int, rng: np.random.Generator) -> I64:
        """Return the states of `count` trajectories of a policy (H, S, A), (H, count)."""
        horizon, _, choices = policy.shape
        below, found = np.cumsum(policy, axis=2)[..., :-1], np.empty((horizon, count), np.int64)
        now = rng.choice(self._mdp.states, count, p=self._mdp.start)
        for t, (of_action, of_move) in enumerate(rng.random((horizon, 2, count))):
            found[t] = now
            action = (below[t, now] <= of_action[:, None]).sum(axis=1)
            entry = np.searchsorted(self._reach, now * choices + action + of_move * (1 - _NEAR), side="right")
            now = self._to[entry.clip(max=len(self._to) - 1)]
        return found
