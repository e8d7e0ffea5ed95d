"""Confidence intervals: of a success rate, of a paired difference of two, and of a mean over training seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import optimize, special, stats

from manip_il.errors import UsageError

CONFIDENCE = 0.95  # of every interval, and one minus the level of every test
_EDGE = 1e-12  # as near to 0 and 1 as a rate's likelihood is computed


@dataclass(frozen=True, slots=True)
class Proportion:
    """`successes` of `n` trials with Wilson's interval; prints as `98.7 % [97.8, 99.3]`.

    sequential: `n` depended on the outcomes so far, so the interval is that of a confidence sequence.
    """

    successes: int
    n: int
    sequential: bool = False

    def __post_init__(self) -> None:
        require_counts(self.successes, self.n)

    @classmethod
    def of(cls, outcomes: Sequence[bool], sequential: bool = False) -> Proportion:
        """Return the proportion of true values."""
        return cls(sum(map(bool, outcomes)), len(outcomes), sequential)

    @property
    def rate(self) -> float:
        """The observed share, in [0, 1]."""
        return self.successes / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's (low, high), or that of a confidence sequence."""
        return (confidence_sequence if self.sequential else wilson_interval)(self.successes, self.n)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{format_percent(self.rate)} [{100 * low:.1f}, {100 * high:.1f}]"


def format_percent(rate: float) -> str:
    """Return a share as `98.7 %`."""
    return f"{100 * rate:.1f} %"


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Return the score interval (low, high) of a binomial proportion; `UsageError` for impossible counts.

    Wilson (1927), J. Am. Stat. Assoc. 22, 209-212.
    """
    require_counts(successes, n)
    found = stats.binomtest(successes, n).proportion_ci(CONFIDENCE, method="wilson")
    # At the ends the formula gives the rate itself, but for rounding.
    return (0.0 if successes == 0 else float(found.low)), (1.0 if successes == n else float(found.high))


def confidence_sequence(successes: int, n: int) -> tuple[float, float]:
    """Return (low, high) of a binomial proportion that holds at every `n` at once, whatever the rule for stopping.

    A rate p is left out once the likelihood of the outcomes, averaged over rates drawn from Beta(1/2, 1/2), is
    1 / (1 - confidence) times that of p: under the true rate this ratio is a martingale of mean 1, so with probability
    `CONFIDENCE` it stays below that (Ville 1939; Robbins 1970, Ann. Math. Stat. 41, 1397-1409). Wider than Wilson's,
    which holds for an `n` fixed in advance. Raises `UsageError` as `wilson_interval` does.
    """
    require_counts(successes, n)
    failures = n - successes
    mixture = special.betaln(successes + 0.5, failures + 0.5) - special.betaln(0.5, 0.5) + math.log1p(-CONFIDENCE)

    def excess(p: float) -> float:
        return float(mixture - special.xlogy(successes, p) - special.xlog1py(failures, -p))

    rate = min(max(successes / n, _EDGE), 1 - _EDGE)
    low = 0.0 if successes == 0 else _root(excess, 1e-300, rate)
    high = 1.0 if failures == 0 else _root(excess, rate, 1 - 1e-16)
    return low, high


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    return cast(float, optimize.brentq(function, low, high, xtol=1e-15))


def paired_difference_interval(both: int, only_first: int, only_second: int, neither: int) -> tuple[float, float]:
    """Return (low, high) of the rate of the first minus the rate of the second, paired, inside [-1, 1].

    Newcombe (1998), Statistics in Medicine 17, 2635-2650, method 10: Wilson's limits of both rates, squared and added,
    less their correlation with a continuity correction.
    """
    n = both + only_first + only_second + neither
    first, second = both + only_first, both + only_second
    require_counts(min(both, only_first, only_second, neither), n)
    (l1, u1), (l2, u2) = wilson_interval(first, n), wilson_interval(second, n)
    p1, p2 = first / n, second / n
    cross = both * neither - only_first * only_second
    if cross > 0:  # the correction draws a positive correlation towards none, never past it
        cross = max(cross - n / 2, 0.0)
    margins = math.sqrt(first * (n - first) * second * (n - second))
    phi = cross / margins if margins else 0.0

    def add_squares(a: float, b: float) -> float:
        return math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b))

    difference = (only_first - only_second) / n
    return max(-1.0, difference - add_squares(p1 - l1, u2 - p2)), min(1.0, difference + add_squares(u1 - p1, p2 - l2))


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return Student's (low, high) of the mean of independent `values`; `UsageError` for fewer than two.

    Student (1908), Biometrika 6, 1-25. With two or three values it is wide: the factor on the standard error is 12.7
    or 4.3, against 2.0 for many values.
    """
    if len(values) < 2:
        raise UsageError(f"{len(values)} training seed has no interval over training seeds; expected at least 2")
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values))
    mean = float(np.mean(values))
    return mean - half, mean + half


def require_counts(successes: int, n: int) -> None:
    """Raise `UsageError` unless 0 <= successes <= n and n >= 1."""
    if n < 1 or not 0 <= successes <= n:
        raise UsageError(f"{successes} successes of {n} trials; expected 0 <= successes <= n and n >= 1")
