"""The three methods of inverse reinforcement learning, behind one function with one type of result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from manip_il.chapter.rewards import bayesian, max_entropy, max_margin
from manip_il.mdp import F64
from manip_il.tasks.carry.paths import LENGTH, Demonstration, open_features, rivals

METHODS = ("max_margin", "bayesian", "max_entropy")
LEVEL = 0.9  # level of the credible intervals
_TASTES = 20  # random weight vectors whose paths show whether a feature matters


@dataclass(frozen=True)
class Learnt:
    """The weights that a method found.

    weights: (K,), divided by the weight of length. open: indices of the weights that are not identified, see
    `open_features`. intervals: the weights' credible intervals, (K, 2), or None. chains: quality of the sampling, in
    words.
    """

    method: str
    weights: F64
    open: tuple[int, ...] = ()
    intervals: F64 | None = None
    chains: str = ""


def learn(method: str, demonstrations: Sequence[Demonstration], rng: np.random.Generator) -> Learnt:
    """Return the weights that a method of `METHODS` infers from one or more demonstrations."""
    tastes = bayesian.prior_tastes(_TASTES, demonstrations[0].problem.features.shape[1], rng)
    unknown = tuple(open_features(demonstrations, rivals(demonstrations, tastes)))
    if method == "bayesian":
        found = bayesian.fit(demonstrations, rng)
        chains, count, _ = found.draws.shape
        words = f"{chains} chains of {count:,} draws; R-hat at most {found.agreement.max():.3f}."
        return Learnt(method, found.mean / found.mean[LENGTH], unknown, found.ratios(LENGTH, LEVEL), words)
    weights = (max_margin if method == "max_margin" else max_entropy).fit(demonstrations)
    return Learnt(method, weights / weights[LENGTH], unknown)


def prior_interval() -> tuple[float, float]:
    """Return the prior interval of the ratio of two weights; for exponentials P(ratio < r) = r / (1 + r)."""
    low, high = (1 - LEVEL) / 2, (1 + LEVEL) / 2
    return low / (1 - low), high / (1 - high)
