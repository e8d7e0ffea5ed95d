"""Losses of cloning and DAgger over the horizon, beside what the two theorems allow.

Theorem 8.1: a policy that errs in a share eps of the expert's states loses at most H^2 eps (Ross & Bagnell 2010).
Theorem 8.2: one that errs in a share eps of its own states loses at most u H eps, where u is the most that one wrong
step costs an expert who drives on (Ross et al. 2011, Theorem 2.2; the chapter has u in its constant). Rewards are 0 to
1 a step.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards.finite import deterministic
from manip_il.seeding import rng_for
from manip_il.theory.problems import (
    PLACES,
    PROBLEMS,
    RIGHT,
    WRONG,
    Problem,
    expert_visits,
    expert_worth,
    recoverability,
    wrong_costs,
)

F64 = NDArray[np.float64]
HORIZONS = (10, 20, 40, 80, 160, 320, 640)
ERROR = 0.03  # of a policy on average, times the horizon: so small that the gap does not saturate
DRAWS = 16  # of the data that a policy is fitted on, at each horizon
ROUNDS, MORE = 5, 20  # DAgger's, each with a share 1 / MORE of as many trajectories as the expert's
_BOOTSTRAPS = 2_000
_ROUNDING = 1e-9
Learner = Literal["cloning", "DAgger"]
Fit = Literal["worst", "even", "constructed"]


@dataclass(frozen=True)
class Loss:
    """Loss of a policy. error: share of the states in which it errs; gap: the expert's return less its own.

    bound: on the gap, by the learner's theorem.
    """

    error: float
    gap: float
    bound: float

    @property
    def above(self) -> bool:
        """Whether the gap is above its bound by more than rounding."""
        return self.gap > self.bound * (1 + _ROUNDING) + _ROUNDING


@dataclass(frozen=True)
class Curve:
    """Losses of a learner over the horizon, one for each draw of its data.

    fit: in states without data the worst action, or either evenly; or a policy constructed to err so often.
    """

    problem: str
    learner: Learner
    fit: Fit
    horizons: tuple[int, ...]
    losses: tuple[tuple[Loss, ...], ...]

    @property
    def ratios(self) -> list[float]:
        """Mean gap over mean error at each horizon."""
        return [_ratio(np.array([[loss.gap, loss.error] for loss in draws])) for draws in self.losses]

    @property
    def slope(self) -> float:
        """The power of the horizon with which gap over error grows."""
        return _power(self.horizons, self.ratios)

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the slope, by bootstrap over draws at each horizon."""
        rng = rng_for(0, f"slope of {self.problem}, {self.learner}, {self.fit}")
        draws = [np.array([[loss.gap, loss.error] for loss in one]) for one in self.losses]
        slopes = [
            _power(self.horizons, [_ratio(one[rng.integers(len(one), size=len(one))]) for one in draws])
            for _ in range(_BOOTSTRAPS if len(draws[0]) > 1 else 1)
        ]
        low, high = np.nanquantile(slopes, [0.025, 0.975])
        return float(low), float(high)

    @property
    def largest_error(self) -> float:
        """Largest error of a policy, times its horizon: far below 1 where the gap does not saturate."""
        return max(loss.error * h for h, draws in zip(self.horizons, self.losses, strict=True) for loss in draws)

    @property
    def above(self) -> int:
        """Number of policies whose gap is above its bound."""
        return sum(loss.above for draws in self.losses for loss in draws)

    def to_json(self) -> dict[str, Any]:
        """Return everything for a file."""
        return asdict(self) | {"slope": self.slope, "interval": self.interval, "above": self.above}


def all_curves(horizons: Sequence[int] = HORIZONS, draws: int = DRAWS) -> Iterator[Curve]:
    """Yield the curves of every problem, learner and fit."""
    for problem in PROBLEMS:
        yield from curves(problem, horizons, draws)


def curves(problem: Problem, horizons: Sequence[int], draws: int) -> Iterator[Curve]:
    """Yield the curves of both learners on one problem."""
    fits: tuple[Fit, ...] = ("worst", "even")
    for fit in fits:
        pairs = [[_fitted(problem, horizon, fit, draw) for draw in range(draws)] for horizon in horizons]
        yield Curve(problem.name, "cloning", fit, tuple(horizons), tuple(tuple(c for c, _ in row) for row in pairs))
        yield Curve(problem.name, "DAgger", fit, tuple(horizons), tuple(tuple(d for _, d in row) for row in pairs))
    off = tuple((cloning_loss(problem, constructed(problem, h, ERROR / h, off_data=True)),) for h in horizons)
    own = tuple((dagger_loss(problem, constructed(problem, h, ERROR / h, off_data=False)),) for h in horizons)
    yield Curve(problem.name, "cloning", "constructed", tuple(horizons), off)
    yield Curve(problem.name, "DAgger", "constructed", tuple(horizons), own)


def cloning_loss(problem: Problem, policy: F64) -> Loss:
    """Return the loss of a policy (H, S, A) with its error in the expert's states, and Theorem 8.1's bound."""
    horizon = len(policy)
    error = _error(policy, expert_visits(problem, horizon))
    return Loss(error, _gap(problem, policy), horizon**2 * error)


def dagger_loss(problem: Problem, policy: F64) -> Loss:
    """Return the loss of a policy (H, S, A) with its error in its own states, and Theorem 8.2's bound."""
    horizon = len(policy)
    error = _error(policy, problem.mdp.visits(policy))
    return Loss(error, _gap(problem, policy), recoverability(problem, horizon) * horizon * error)


def constructed(problem: Problem, horizon: int, error: float, *, off_data: bool) -> F64:
    """Return a policy (H, S, A) that errs with a probability in every state.

    off_data: err always where the expert never is, and so gives no data.
    """
    policy = np.tile([1 - error, error], (horizon, problem.mdp.states, 1))
    if off_data:
        policy[expert_visits(problem, horizon) == 0] = [0.0, 1.0]
    return _mended(problem, policy)


def clone(problem: Problem, seen: NDArray[np.bool_], fit: Fit) -> F64:
    """Return the policy (H, S, A) of greatest likelihood on labels of the states seen (H, S).

    The label where there is one, else the worst action that is left open, or either evenly; where no action is worse
    than the expert's, as after a fall, it does as the expert.
    """
    policy = deterministic(np.where(seen, RIGHT, WRONG), 2)
    if fit == "even":
        policy[~seen] = 0.5
    return _mended(problem, policy)


def dagger(problem: Problem, seen: NDArray[np.bool_], fit: Fit, count: int, rng: np.random.Generator) -> F64:
    """Return DAgger's policy (H, S, A), of `count` trajectories a round: the best of all rounds, as in Definition 8.2.

    seen: states (H, S) with labels of the expert's own trajectories, to begin with.
    """
    policies = [clone(problem, seen, fit)]
    for _ in range(ROUNDS):
        seen = seen | _seen(problem, policies[-1], count, rng)
        policies.append(clone(problem, seen, fit))
    return min(policies, key=lambda policy: _error(policy, problem.mdp.visits(policy)))


def _fitted(problem: Problem, horizon: int, fit: Fit, draw: int) -> tuple[Loss, Loss]:
    """Losses of cloning and of DAgger on as many trajectories: so many that a share of about `ERROR` / H is unseen."""
    rng = rng_for(draw, f"trajectories of {horizon} steps, {problem.name}")
    count = int(np.ceil(PLACES * np.log(horizon / ERROR)))
    cloned = cloning_loss(problem, clone(problem, _seen(problem, problem.expert(horizon), count, rng), fit))
    first = round(count / (1 + ROUNDS / MORE))
    seen = _seen(problem, problem.expert(horizon), first, rng)
    return cloned, dagger_loss(problem, dagger(problem, seen, fit, first // MORE, rng))


def _seen(problem: Problem, policy: F64, count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Whether some of `count` trajectories of a policy is in a state at a step, (H, S)."""
    states = problem.sampler.states(policy, count, rng)
    seen = np.zeros((len(policy), problem.mdp.states), np.bool_)
    np.put_along_axis(seen, states, True, axis=1)
    return seen


def _mended(problem: Problem, policy: F64) -> F64:
    """Without errors that cost nothing: there, the theorems' expert may act as the policy does."""
    policy = policy.copy()
    policy[wrong_costs(problem, len(policy)) <= 0] = [1.0, 0.0]
    return policy


def _error(policy: F64, visits: F64) -> float:
    return float((visits * policy[..., WRONG]).sum() / len(policy))


def _gap(problem: Problem, policy: F64) -> float:
    return expert_worth(problem, len(policy)) - problem.mdp.worth(policy)


def _ratio(gaps_and_errors: F64) -> float:
    gap, error = gaps_and_errors.mean(axis=0)
    return float(gap / error) if error > 0 else float("nan")


def _power(horizons: Sequence[int], ratios: Sequence[float]) -> float:
    return float(np.polyfit(np.log(horizons), np.log(ratios), 1)[0])
