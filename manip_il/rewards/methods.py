"""The three methods of inverse reinforcement learning side by side, and what they find in one form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards import bayesian, max_entropy, max_margin
from manip_il.rewards.paths import LENGTH, Demonstration, open_features, rivals

F64 = NDArray[np.float64]
LEVEL = 0.9  # of intervals
_TASTES = 20  # that tell whether paths differ in a feature


@dataclass(frozen=True)
class Learnt:
    """Weights as a method found them.

    weights: (K,), over that of length. intervals: of them, (K, 2), if the method has them. facts: in words. open:
    features in which all demonstrations agree, so that nothing is known of their weights.
    """

    method: str
    weights: F64
    facts: tuple[str, ...]
    intervals: F64 | None = None
    open: tuple[int, ...] = ()


def learn(method: str, demonstrations: Sequence[Demonstration], rng: np.random.Generator) -> Learnt:
    """Return what a method of `METHODS` finds of one demonstration or more."""
    tastes = bayesian.prior_tastes(_TASTES, demonstrations[0].problem.features.shape[1], rng)
    unknown = tuple(open_features(demonstrations, rivals(demonstrations, tastes)))
    weights, intervals, facts = METHODS[method](demonstrations, rng)
    return Learnt(method, weights / weights[LENGTH], facts, intervals, unknown)


def prior_interval(level: float = LEVEL) -> tuple[float, float]:
    """Return the prior's interval of a weight over another: of two exponential ones, P(ratio < r) = r / (1 + r)."""
    low, high = (1 - level) / 2, (1 + level) / 2
    return low / (1 - low), high / (1 - high)


Found = tuple[F64, F64 | None, tuple[str, ...]]  # weights (K,), their intervals over length's (K, 2), facts


def _max_margin(shown: Sequence[Demonstration], _rng: np.random.Generator) -> Found:
    return max_margin.fit(shown), None, ()


def _max_entropy(shown: Sequence[Demonstration], _rng: np.random.Generator) -> Found:
    weights = max_entropy.fit(shown)
    surer = f"A metre of path is weighed {weights[LENGTH]:.0f} fold: the larger, the surer was the demonstrator."
    return weights, None, (surer,)


def _bayesian(shown: Sequence[Demonstration], rng: np.random.Generator) -> Found:
    found, sums = bayesian.fit(shown, rng)
    chains, count, _ = found.draws.shape
    facts = (
        f"{chains} chains of {count:,} draws, {found.accepted:.0%} of the steps taken; R-hat at most "
        f"{found.agreement.max():.3f}.",
        f"A demonstration is one of {np.mean([len(one) for one in sums]):.0f} paths, on average, that are the cheapest "
        "for some taste.",
    )
    return found.mean, found.ratios(LENGTH, LEVEL), facts


METHODS: dict[str, Callable[[Sequence[Demonstration], np.random.Generator], Found]] = {
    "max_margin": _max_margin,
    "bayesian": _bayesian,
    "max_entropy": _max_entropy,
}
