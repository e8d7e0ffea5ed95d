"""Processes small enough to be solved, told apart by what one wrong step costs an expert who drives on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards.finite import FiniteMDP, Trajectories, deterministic

F64, I64 = NDArray[np.float64], NDArray[np.int64]
PLACES = 100  # states that the expert is in
RIGHT, WRONG = 0, 1  # the expert's action everywhere, and the other one


@dataclass(frozen=True, eq=False)
class Problem:
    """A process on which the expert always acts `RIGHT`, for rewards of 0 to 1 a step.

    words: what a wrong action does. slopes: powers of the horizon with which the gap over the policy's own error grows,
    of cloning and of DAgger, as the theorems have it.
    """

    name: str
    words: str
    mdp: FiniteMDP
    slopes: tuple[float, float]

    @cached_property
    def sampler(self) -> Trajectories:
        """Draws trajectories of this process."""
        return Trajectories(self.mdp)

    def expert(self, horizon: int) -> F64:
        """Return the expert's policy, (H, S, A)."""
        return deterministic(np.full((horizon, self.mdp.states), RIGHT), 2)


@cache
def expert_visits(problem: Problem, horizon: int) -> F64:
    """Return the distribution of the expert's state at each step, (H, S)."""
    return problem.mdp.visits(problem.expert(horizon))


@cache
def expert_worth(problem: Problem, horizon: int) -> float:
    """Return the expert's expected sum of rewards."""
    return problem.mdp.worth(problem.expert(horizon))


@cache
def wrong_costs(problem: Problem, horizon: int) -> F64:
    """Return what one wrong action costs in each state and step, the expert driving on, (H, S)."""
    return problem.mdp.gaps(problem.expert(horizon))[..., WRONG]


@cache
def recoverability(problem: Problem, horizon: int) -> float:
    """Return u: the most that one wrong action costs, in states that some policy gets to, the expert driving on."""
    anyhow = np.full((horizon, problem.mdp.states, 2), 0.5)
    return float(wrong_costs(problem, horizon)[problem.mdp.visits(anyhow) > 0].max())


def _beside(back: float) -> FiniteMDP:
    """`PLACES` that follow on each other by chance, and one beside them that a wrong action leads to.

    back: probability that the right action leads back from there.
    """
    moves, rewards, beside = np.zeros((PLACES + 1, 2, PLACES + 1)), np.zeros((PLACES + 1, 2)), PLACES
    moves[:PLACES, RIGHT, :PLACES] = 1 / PLACES
    moves[:PLACES, WRONG, beside] = 1.0
    moves[beside, RIGHT, :PLACES] = back / PLACES
    moves[beside, RIGHT, beside] = 1 - back
    moves[beside, WRONG, beside] = 1.0
    rewards[:PLACES, RIGHT] = 1.0
    return FiniteMDP.of(moves, rewards, np.append(np.full(PLACES, 1 / PLACES), 0.0))


def _ring() -> FiniteMDP:
    """`PLACES` in a ring: the right action leads one or two on, the wrong one back; the expert is in all of them."""
    on = (np.roll(np.eye(PLACES), 1, axis=1) + np.roll(np.eye(PLACES), 2, axis=1)) / 2
    rewards = np.tile([1.0, 0.0], (PLACES, 1))
    return FiniteMDP.of(np.stack([on, on.T], axis=1), rewards, np.full(PLACES, 1 / PLACES))


PROBLEMS = (
    Problem("mended walk", "leads off the way, from where the expert is back in one step", _beside(1.0), (2, 1)),
    Problem("tightrope", "is a fall that nothing mends", _beside(0.0), (2, 2)),
    Problem("visited chain", "leads to another state that the expert visits", _ring(), (1, 1)),
)
