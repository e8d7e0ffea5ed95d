"""The three methods of inverse reinforcement learning side by side, and what they find in one form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards import bayesian, max_entropy, max_margin
from manip_il.rewards.paths import LENGTH, Demonstration, open_features, rivals

F64 = NDArray[np.float64]
METHODS = ("max_margin", "bayesian", "max_entropy")
LEVEL = 0.9  # of intervals
_TASTES = 20  # that tell whether paths differ in a feature


@dataclass(frozen=True)
class Learnt:
    """Weights as a method found them.

    weights: (K,), over that of length. open: features in which all demonstrations agree, so that nothing is known of
    their weights. intervals: of the weights, (K, 2), if the method has them; chains: how well they are known, in words.
    """

    method: str
    weights: F64
    open: tuple[int, ...] = ()
    intervals: F64 | None = None
    chains: str = ""


def learn(method: str, demonstrations: Sequence[Demonstration], rng: np.random.Generator) -> Learnt:
    """Return what a method of `METHODS` finds of one demonstration or more."""
    tastes = bayesian.prior_tastes(_TASTES, demonstrations[0].problem.features.shape[1], rng)
    unknown = tuple(open_features(demonstrations, rivals(demonstrations, tastes)))
    if method == "bayesian":
        found = bayesian.fit(demonstrations, rng)
        chains, count, _ = found.draws.shape
        words = f"{chains} chains of {count:,} draws; R-hat at most {found.agreement.max():.3f}."
        return Learnt(method, found.mean / found.mean[LENGTH], unknown, found.ratios(LENGTH, LEVEL), words)
    weights = (max_margin if method == "max_margin" else max_entropy).fit(demonstrations)
    return Learnt(method, weights / weights[LENGTH], unknown)


def prior_interval(level: float = LEVEL) -> tuple[float, float]:
    """Return the prior's interval of a weight over another: of two exponential ones, P(ratio < r) = r / (1 + r)."""
    low, high = (1 - level) / 2, (1 + level) / 2
    return low / (1 - low), high / (1 - high)
