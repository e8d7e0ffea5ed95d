"""Confidence intervals of a success rate and of a mean over training seeds; standard library only."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist, fmean, stdev

from manip_il.errors import UsageError

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Proportion:
    """`successes` of `n` trials with Wilson's interval; prints as `98.7 % [97.8, 99.3]`.

    sequential: `n` depended on the outcomes so far, so the interval is that of a confidence sequence.
    """

    successes: int
    n: int
    confidence: float = CONFIDENCE
    sequential: bool = False

    def __post_init__(self) -> None:
        require_counts(self.successes, self.n)
        require_confidence(self.confidence)

    @classmethod
    def of(cls, outcomes: Sequence[bool], confidence: float = CONFIDENCE, sequential: bool = False) -> Proportion:
        """Return the proportion of true values."""
        return cls(sum(map(bool, outcomes)), len(outcomes), confidence, sequential)

    @property
    def rate(self) -> float:
        """The observed share, in [0, 1]."""
        return self.successes / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's (low, high), or that of a confidence sequence."""
        method = confidence_sequence if self.sequential else wilson_interval
        return method(self.successes, self.n, self.confidence)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{format_percent(self.rate)} [{100 * low:.1f}, {100 * high:.1f}]"


def format_percent(rate: float) -> str:
    """Return a share as `98.7 %`."""
    return f"{100 * rate:.1f} %"


def wilson_interval(successes: int, n: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the score interval (low, high) of a binomial proportion, inside [0, 1].

    Wilson (1927), J. Am. Stat. Assoc. 22, 209-212. Raises `UsageError` unless 0 <= successes <= n and n >= 1.
    """
    require_counts(successes, n)
    require_confidence(confidence)
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate = successes / n
    denominator = 1 + z * z / n
    centre = (rate + z * z / (2 * n)) / denominator
    half = z / denominator * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # At the ends the formula gives the rate itself, but for rounding.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == n else min(1.0, centre + half)
    return low, high


def confidence_sequence(successes: int, n: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return (low, high) of a binomial proportion that holds at every `n` at once, whatever the rule for stopping.

    A rate p is left out once the likelihood of the outcomes, averaged over rates drawn from Beta(1/2, 1/2), is
    1 / (1 - confidence) times that of p: under the true rate this ratio is a martingale of mean 1, so with probability
    `confidence` it stays below that (Ville 1939; Robbins 1970, Ann. Math. Stat. 41, 1397-1409). Wider than Wilson's,
    which holds for an `n` fixed in advance. Raises `UsageError` as `wilson_interval` does.
    """
    require_counts(successes, n)
    require_confidence(confidence)
    failures = n - successes
    mixture = _log_beta(successes + 0.5, failures + 0.5) - _log_beta(0.5, 0.5)

    def inside(p: float) -> bool:
        log_likelihood = (successes * math.log(p) if successes else 0.0) + (
            failures * math.log1p(-p) if failures else 0.0
        )
        return mixture - log_likelihood < -math.log1p(-confidence)

    rate = min(max(successes / n, 1e-12), 1 - 1e-12)  # at 0 and 1 there is no logarithm
    low = 0.0 if successes == 0 else _bisect(inside, rate, 0.0)
    high = 1.0 if failures == 0 else _bisect(inside, rate, 1.0)
    return low, high


def mean_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return Student's (low, high) of the mean of independent `values`; `UsageError` for fewer than two.

    Student (1908), Biometrika 6, 1-25. With two or three values it is wide: the factor on the standard error is 12.7
    or 4.3, against 2.0 for many values.
    """
    if len(values) < 2:
        raise UsageError(f"{len(values)} training seed has no interval over training seeds; expected at least 2")
    half = t_quantile(confidence, len(values) - 1) * stdev(values) / math.sqrt(len(values))
    return fmean(values) - half, fmean(values) + half


def t_quantile(confidence: float, degrees: int) -> float:
    """Return Student's t with `degrees` of freedom for a two-sided interval of this confidence."""
    if degrees < 1 or not 0 < confidence < 1:
        raise UsageError(
            f"t quantile of {confidence} with {degrees} degrees of freedom; expected 0 to 1 and at least 1"
        )
    angle = _bisect(lambda angle: _t_probability(angle, degrees) < confidence, 0.0, math.pi / 2)
    return math.sqrt(degrees) * math.tan(angle)


def require_counts(successes: int, n: int) -> None:
    """Raise `UsageError` unless 0 <= successes <= n and n >= 1."""
    if n < 1 or not 0 <= successes <= n:
        raise UsageError(f"{successes} successes of {n} trials; expected 0 <= successes <= n and n >= 1")


def require_confidence(confidence: float) -> None:
    """Raise `UsageError` unless the confidence is between 0 and 1."""
    if not 0 < confidence < 1:
        raise UsageError(f"confidence is {confidence}; expected a number between 0 and 1, such as 0.95")


def _bisect(inside: Callable[[float], bool], within: float, outside: float) -> float:
    """Find where `inside` ends between a value that is inside and one that is not; neither is evaluated."""
    for _ in range(60):  # halves the error each time: to the last bit
        middle = (within + outside) / 2
        within, outside = (middle, outside) if inside(middle) else (within, middle)
    return (within + outside) / 2


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def _t_probability(angle: float, degrees: int) -> float:
    """P(|T| <= t) where tan(angle) = t / sqrt(degrees): Abramowitz & Stegun (1964), 26.7.3 and 26.7.4."""
    sine, cosine = math.sin(angle), math.cos(angle)
    odd = degrees % 2
    term = cosine if odd else 1.0
    series = 0.0 if degrees == 1 else term
    for k in range(3 if odd else 2, degrees, 2):
        term *= cosine * cosine * (k - 1) / k
        series += term
    return 2 / math.pi * (angle + sine * series) if odd else sine * series
