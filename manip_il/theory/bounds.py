"""Losses of cloning and DAgger over the horizon, beside what the two theorems allow.

Theorem 8.1: a policy that errs in a share eps of the expert's states loses at most H^2 eps (Ross & Bagnell 2010).
Theorem 8.2: one that errs in a share eps of its own states loses at most u H eps, where u is the most that one wrong
step costs an expert who drives on (Ross et al. 2011, Theorem 2.2; the chapter has u in its constant). Rewards are 0 to
1 a step.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.seeding import rng_for
from manip_il.theory.processes import PLACES, PROCESSES, Process

F64 = NDArray[np.float64]
HORIZONS = (10, 20, 40, 80, 160, 320, 640)
ERROR = 0.03  # of a policy on average, times the horizon: so small that the gap does not saturate
DRAWS = 16  # of the data that a policy is fitted on, at each horizon
ROUNDS, MORE = 5, 20  # DAgger's, each with a share 1 / MORE of as many trajectories as the expert's
_BOOTSTRAPS = 2_000
_ROUNDING = 1e-9
Learner = Literal["cloning", "DAgger"]
Fit = Literal["worst", "even", "constructed"]
TIES: dict[Fit, float] = {"worst": 1.0, "even": 0.5}  # how often a fit errs in states without data


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

    @cached_property
    def _gaps_and_errors(self) -> F64:
        """Of every horizon and draw, (h, D, 2)."""
        return np.array([[[loss.gap, loss.error] for loss in draws] for draws in self.losses])

    @property
    def ratios(self) -> list[float]:
        """Mean gap over mean error at each horizon; NaN if no policy errs."""
        return _ratios(self._gaps_and_errors.mean(axis=1)).tolist()

    @property
    def slope(self) -> float:
        """The power of the horizon with which gap over error grows; NaN if that is not known at each."""
        return float(np.append(_powers(self.horizons, np.array(self.ratios)[:, None]), np.nan)[0])

    @cached_property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the slope, by bootstrap over draws at each horizon."""
        rng = rng_for(0, f"slope of {self.problem}, {self.learner}, {self.fit}")
        horizons, draws, _ = self._gaps_and_errors.shape
        chosen = rng.integers(draws, size=(_BOOTSTRAPS, horizons, draws))
        ratios = _ratios(self._gaps_and_errors[np.arange(horizons)[:, None], chosen].mean(axis=2))
        slopes = _powers(self.horizons, ratios.T)
        low, high = np.quantile(slopes, [0.025, 0.975]) if slopes.size else (np.nan, np.nan)
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
    """Yield the curves of every process, learner and fit."""
    for process in PROCESSES:
        yield from curves(process, horizons, draws)


def curves(process: Process, horizons: Sequence[int], draws: int) -> Iterator[Curve]:
    """Yield the curves of both learners on one process: of both fits, then of policies constructed to err."""
    found: dict[tuple[Learner, Fit], list[tuple[Loss, ...]]] = {}
    for horizon in horizons:
        for name, losses in _fitted(process, horizon, draws).items():
            found.setdefault(name, []).append(losses)
        for learner in ("cloning", "DAgger"):
            policy = constructed(process, horizon, ERROR / horizon, off_data=learner == "cloning")
            found.setdefault((learner, "constructed"), []).append(losses_of(process, learner, policy[None]))
    for (learner, fit), losses in found.items():
        yield Curve(process.name, learner, fit, tuple(horizons), tuple(losses))


def losses_of(process: Process, learner: Learner, policies: F64) -> tuple[Loss, ...]:
    """Return the loss of each policy (B, H, S), with its error and bound by the learner's theorem.

    cloning: error in the expert's states, Theorem 8.1; DAgger: in the policy's own, Theorem 8.2. The gap is what the
    policy's wrong actions cost in the states that it visits (the performance difference lemma).
    """
    horizon, own = policies.shape[1], process.visits(policies) * policies
    gaps = (own * process.wrong_costs(horizon)).sum(axis=(1, 2))
    wrong = process.expert_visits(horizon) * policies if learner == "cloning" else own
    factor = horizon if learner == "cloning" else process.recoverability(horizon)
    errors = wrong.sum(axis=(1, 2)) / horizon
    return tuple(Loss(e, g, factor * horizon * e) for e, g in zip(errors.tolist(), gaps.tolist(), strict=True))


def constructed(process: Process, horizon: int, error: float, *, off_data: bool) -> F64:
    """Return a policy (H, S) that errs with a probability in every state.

    off_data: err always where the expert never is, and so gives no data.
    """
    policy = np.full((horizon, process.states), error)
    if off_data:
        policy[process.expert_visits(horizon) == 0] = 1.0
    return _mended(process, policy)


def clone(process: Process, seen: NDArray[np.bool_], ties: F64 | float) -> F64:
    """Return the policies (..., H, S) of greatest likelihood on labels of the states seen (..., H, S).

    The label where there is one, else wrong in a share `ties`; where no action is worse than the expert's, as after a
    fall, it does as the expert.
    """
    return _mended(process, np.where(seen, 0.0, ties))


def dagger(
    process: Process, seen: NDArray[np.bool_], ties: F64 | float, count: int, rngs: list[np.random.Generator]
) -> F64:
    """Return DAgger's policies (B, H, S), of `count` trajectories a round: the best of all rounds (Definition 8.2).

    seen: states (B, H, S) with labels of the expert's own trajectories, to begin with. rngs: see `Process.seen`.
    """
    best, least = np.empty(seen.shape), np.full(len(seen), np.inf)
    for round_ in range(ROUNDS + 1):
        policy = clone(process, seen, ties)
        errors = (process.visits(policy) * policy).sum(axis=(1, 2))
        better = errors < least
        best[better], least[better] = policy[better], errors[better]
        if round_ < ROUNDS:
            seen = seen | process.seen(policy, count, rngs)
    return best


def _fitted(process: Process, horizon: int, draws: int) -> dict[tuple[Learner, Fit], tuple[Loss, ...]]:
    """Losses of cloning and of DAgger on as many trajectories: so many that a share of about `ERROR` / H is unseen."""
    rngs = [rng_for(draw, f"trajectories of {horizon} steps, {process.name}") for draw in range(draws)]
    count = int(np.ceil(PLACES * np.log(horizon / ERROR)))
    first = round(count / (1 + ROUNDS / MORE))
    expert = np.zeros((1, horizon, process.states))
    for_clone, for_dagger = (
        np.concatenate([process.seen(expert, number, [rng]) for rng in rngs]) for number in (count, first)
    )
    found: dict[tuple[Learner, Fit], tuple[Loss, ...]] = {}
    ties = np.repeat(list(TIES.values()), draws)[:, None, None]
    improved = dagger(process, np.tile(for_dagger, (len(TIES), 1, 1)), ties, first // MORE, rngs)
    for number, (fit, share) in enumerate(TIES.items()):
        found["cloning", fit] = losses_of(process, "cloning", clone(process, for_clone, share))
        found["DAgger", fit] = losses_of(process, "DAgger", improved[number * draws : (number + 1) * draws])
    return found


def _mended(process: Process, policy: F64) -> F64:
    """Without errors that cost nothing: there, the theorems' expert may act as the policy does."""
    return np.where(process.wrong_costs(policy.shape[-2]) <= 0, 0.0, policy)


def _ratios(gaps_and_errors: F64) -> F64:
    """Gap over error (...) of both, (..., 2); NaN without an error."""
    gaps, errors = np.moveaxis(gaps_and_errors, -1, 0)
    return np.divide(gaps, errors, out=np.full(gaps.shape, np.nan), where=errors > 0)


def _powers(horizons: Sequence[int], ratios: F64) -> F64:
    """Slopes in log-log of the columns of ratios (h, n) that are known at each horizon."""
    known = ratios[:, np.isfinite(ratios).all(axis=0)]
    return np.polyfit(np.log(horizons), np.log(known), 1)[0] if known.size else np.empty(0)
