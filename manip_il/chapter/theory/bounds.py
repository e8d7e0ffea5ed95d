"""Losses of cloning and DAgger over the horizon, compared with the bounds of two theorems.

Theorem 8.1: a policy that errs in a share eps of the expert's states loses at most H^2 eps (Ross & Bagnell 2010).
Theorem 8.2: a policy that errs in a share eps of its own states loses at most u H eps; u is the largest cost of one
wrong step if the expert then drives (Ross et al. 2011, Theorem 2.2; a bound stated as H eps hides u in its constant).
The theorems are numbered as in the course, docs/course. Rewards are 0 to 1 per step. Policies are fitted to
trajectories; in states without data they take the worst action, as the theorems allow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.chapter.theory.processes import PLACES, Process
from manip_il.mdp import F64
from manip_il.seeding import rng_for

HORIZONS = (10, 20, 40, 80, 160, 320, 640)
ERROR = 0.03  # mean error of a policy times the horizon, small enough that the gap does not saturate
DRAWS = 16  # training sets drawn at each horizon
ROUNDS, MORE = 5, 20  # DAgger's rounds; each adds 1 / MORE of the initial number of trajectories
_BOOTSTRAPS = 2_000
_ROUNDING = 1e-9
Learner = Literal["cloning", "DAgger"]


@dataclass(frozen=True, eq=False)
class LossCurve:
    """Losses of a learner at each of h horizons, for each of D draws of its training data: arrays (h, D).

    errors: share of states in which the policy errs; gaps: the expert's return minus the policy's; bounds: upper bounds
    on the gaps by the learner's theorem.
    """

    problem: str
    learner: Learner
    horizons: tuple[int, ...]
    errors: F64
    gaps: F64
    bounds: F64

    @property
    def ratios(self) -> F64:
        """Mean gap over mean error at each horizon, (h,)."""
        return self.gaps.mean(axis=1) / self.errors.mean(axis=1)

    @property
    def slope(self) -> float:
        """Exponent with which gap over error grows with the horizon."""
        return float(self._log_slopes(self.ratios))

    @cached_property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the slope, by bootstrap over the draws at each horizon."""
        rng = rng_for(0, f"slope of {self.problem}, {self.learner}, worst")
        horizons, draws = self.gaps.shape
        chosen = rng.integers(draws, size=(_BOOTSTRAPS, horizons, draws))
        gaps, errors = (one[np.arange(horizons)[:, None], chosen].mean(axis=2) for one in (self.gaps, self.errors))
        low, high = np.quantile(self._log_slopes(gaps / errors), [0.025, 0.975])
        return float(low), float(high)

    @property
    def above(self) -> int:
        """Number of policies whose gap exceeds its bound by more than rounding."""
        return int((self.gaps > self.bounds * (1 + _ROUNDING) + _ROUNDING).sum())

    def to_json(self) -> dict[str, Any]:
        """Return the curve as JSON."""
        losses = {name: getattr(self, name).tolist() for name in ("errors", "gaps", "bounds")}
        found = {"slope": self.slope, "interval": self.interval, "above": self.above}
        return {"problem": self.problem, "learner": self.learner, "horizons": self.horizons, **losses, **found}

    def _log_slopes(self, ratios: F64) -> F64:
        """Log-log slopes of ratios (..., h) over the horizons."""
        x = np.log(self.horizons) - np.log(self.horizons).mean()
        return np.log(ratios) @ x / (x @ x)


def curves(process: Process, horizons: Sequence[int] = HORIZONS, draws: int = DRAWS) -> Iterator[LossCurve]:
    """Yield the loss curves of cloning and of DAgger on one process."""
    found: dict[Learner, list[F64]] = {"cloning": [], "DAgger": []}
    for horizon in horizons:
        for learner, policies in _fitted(process, horizon, draws).items():
            found[learner].append(losses_of(process, learner, policies))
    for learner, losses in found.items():
        yield LossCurve(process.name, learner, tuple(horizons), *np.stack(losses, axis=1))


def losses_of(process: Process, learner: Learner, policies: F64) -> F64:
    """Return error, gap and bound, (3, B), of each policy (B, H, S), as the learner's theorem defines them.

    The error is measured in the states of the expert (cloning, Theorem 8.1) or the policy (DAgger, Theorem 8.2). The
    gap is the cost of the policy's wrong actions in the states that it visits (the performance difference lemma).
    """
    horizon, own = policies.shape[1], process.visits(policies) * policies
    gaps = (own * process.wrong_costs(horizon)).sum(axis=(1, 2))
    wrong = process.visits(np.zeros((horizon, process.states))) * policies if learner == "cloning" else own
    factor = horizon if learner == "cloning" else process.recoverability(horizon)
    errors = wrong.sum(axis=(1, 2)) / horizon
    return np.stack([errors, gaps, factor * horizon * errors])


def clone(process: Process, seen: NDArray[np.bool_]) -> F64:
    """Return policies (..., H, S) fitted to labels in the seen states (..., H, S): right in these, wrong elsewhere.

    In states in which no action is worse than the expert's, such as after a fall, the policies act as the expert.
    """
    return np.where(seen | (process.wrong_costs(seen.shape[-2]) <= 0), 0.0, 1.0)


def dagger(process: Process, seen: NDArray[np.bool_], count: int, rngs: list[np.random.Generator]) -> F64:
    """Return DAgger's policies (B, H, S): those of the round with the fewest errors in its own states (Definition 8.2).

    seen: whether states (B, H, S) have labels from the expert's own trajectories. count: trajectories per round. rngs:
    see `Process.seen`.
    """
    best, least = np.empty(seen.shape), np.full(len(seen), np.inf)
    for round_ in range(ROUNDS + 1):
        policy = clone(process, seen)
        errors = (process.visits(policy) * policy).sum(axis=(1, 2))
        better = errors < least
        best[better], least[better] = policy[better], errors[better]
        if round_ < ROUNDS:
            seen = seen | process.seen(policy, count, rngs)
    return best


def _fitted(process: Process, horizon: int, draws: int) -> dict[Learner, F64]:
    """Cloning's and DAgger's policies from equally many trajectories, which leave about ERROR / H of states unseen."""
    rngs = [rng_for(draw, f"trajectories of {horizon} steps, {process.name}") for draw in range(draws)]
    count = int(np.ceil(PLACES * np.log(horizon / ERROR)))
    first = round(count / (1 + ROUNDS / MORE))
    expert = np.zeros((draws, horizon, process.states))
    for_clone, for_dagger = (process.seen(expert, number, rngs) for number in (count, first))
    return {
        "cloning": clone(process, for_clone),
        "DAgger": dagger(process, for_dagger, first // MORE, rngs),
    }
