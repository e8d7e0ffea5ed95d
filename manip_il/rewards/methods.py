"""The three methods of inverse reinforcement learning side by side, and what they find in one form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UnknownName
from manip_il.rewards import bayesian, max_entropy, max_margin
from manip_il.rewards.demonstrations import Demonstration, base_feature, count_features, open_features, rivals

F64 = NDArray[np.float64]
LEVEL = 0.9  # of intervals
_TASTES = 20  # that tell whether paths differ in a feature


@dataclass(frozen=True)
class Learnt:
    """Weights as a method found them.

    weights: (K,), over that of the base feature. intervals: of them, (K, 2), where the method has them. open: features
    in which all demonstrations agree, so that nothing is known of their weights. beside: weights of another way, (K,),
    by its name. draws: of the posterior, over the base feature's, (C, N, K). facts: in words.
    """

    method: str
    weights: F64
    facts: tuple[str, ...]
    intervals: F64 | None = None
    open: tuple[int, ...] = ()
    beside: tuple[str, F64] | None = None
    draws: F64 | None = None


def learn(method: str, demonstrations: Sequence[Demonstration], rng: np.random.Generator) -> Learnt:
    """Return what a method of `METHODS` finds. Raises `UnknownName`, and where there is nothing to learn from."""
    if method not in METHODS:
        raise UnknownName("method", method, METHODS)
    tastes = bayesian.prior_tastes(_TASTES, count_features(demonstrations), rng)
    unknown = tuple(open_features(demonstrations, rivals(demonstrations, tastes)))
    return METHODS[method](demonstrations, unknown, rng)


def prior_interval(level: float = LEVEL) -> tuple[float, float]:
    """Return the prior's interval of a weight over another: of two exponential ones, P(ratio < r) = r / (1 + r)."""
    low, high = (1 - level) / 2, (1 + level) / 2
    return low / (1 - low), high / (1 - high)


def _max_margin(shown: Sequence[Demonstration], unknown: tuple[int, ...], _rng: np.random.Generator) -> Learnt:
    found, matched = max_margin.fit(shown), max_margin.match_features(shown)
    base = base_feature(shown)
    apart = float(matched.distances[-1])
    facts = (
        f"Maximum margin planning: the demonstrations miss their margins by {found.losses[-1]:.3g} m of path.",
        f"Feature matching by projection: after {len(matched.distances)} steps a mixture of cheapest paths has "
        f"{apart:.2g} m more of the features than the demonstrations; its last weights stand beside, in units of the "
        "largest.",
    )
    beside = matched.weights / max(float(matched.weights.max()), 1e-12)
    return Learnt("max_margin", found.weights / found.weights[base], facts, open=unknown, beside=("projection", beside))


def _max_entropy(shown: Sequence[Demonstration], unknown: tuple[int, ...], _rng: np.random.Generator) -> Learnt:
    found, base = max_entropy.fit(shown), base_feature(shown)
    apart = float(np.abs(found.expected - found.demonstrated).max())
    facts = (
        f"Expected and demonstrated features differ by {apart:.2g} m at most, after {found.evaluations} evaluations.",
        f"A metre of path is weighed {found.weights[base]:.0f} fold: the larger, the surer was the demonstrator.",
    )
    return Learnt("max_entropy", found.weights / found.weights[base], facts, open=unknown)


def _bayesian(shown: Sequence[Demonstration], unknown: tuple[int, ...], rng: np.random.Generator) -> Learnt:
    (found, sums), base = bayesian.fit(shown, rng), base_feature(shown)
    points = found.draws.points
    chains, count, _ = points.shape
    facts = (
        f"{chains} chains of {count:,} draws, {found.draws.accepted:.0%} of the steps taken; worth "
        f"{found.effective.min():.0f} independent ones or more; R-hat at most {found.agreement.max():.3f}.",
        f"A demonstration is one of {np.mean([len(one) for one in sums]):.0f} paths, on average, that are the cheapest "
        "for some taste.",
    )
    ratios, mean = points / points[..., [base]], found.mean
    return Learnt(
        "bayesian", mean / mean[base], facts, found.ratios(base, LEVEL), unknown, draws=np.asarray(ratios, np.float64)
    )


METHODS: dict[str, Callable[[Sequence[Demonstration], tuple[int, ...], np.random.Generator], Learnt]] = {
    "max_margin": _max_margin,
    "bayesian": _bayesian,
    "max_entropy": _max_entropy,
}
