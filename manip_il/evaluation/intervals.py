"""Confidence intervals and exact tests of success: one rate, two policies on the same seeds,
several training seeds.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, special, stats

from manip_il.errors import UsageError

CONFIDENCE = 0.95  # level of every interval, and one minus the significance level of every test
_EDGE = 1e-12  # smallest distance from 0 and 1 at which a rate's likelihood is computed


@dataclass(frozen=True, slots=True)
class Proportion:
    """A number of successes with Wilson's interval; prints as `98.7 % [97.8, 99.3]`.

    Attributes:
        successes: Number of successful trials.
        n: Number of trials.
        sequential: Whether `n` depended on the outcomes so far, so that the interval is that of a
            confidence sequence.
    """

    successes: int
    n: int
    sequential: bool = False

    def __post_init__(self) -> None:
        if self.n < 1 or not 0 <= self.successes <= self.n:
            raise UsageError(
                f"{self.successes} successes of {self.n} trials; expected 0 <= successes <= n and n"
                " >= 1"
            )

    @classmethod
    def of(cls, outcomes: Sequence[bool], sequential: bool = False) -> Proportion:
        """Return the proportion of true values in `outcomes`."""
        return cls(sum(map(bool, outcomes)), len(outcomes), sequential)

    @property
    def rate(self) -> float:
        """The observed share, in [0, 1]."""
        return self.successes / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high): Wilson's interval, or that of a confidence sequence if `sequential`."""
        return (confidence_sequence if self.sequential else wilson_interval)(self.successes, self.n)

    def to_json(self) -> dict[str, Any]:
        """Return rate, interval and number of episodes, as in result files."""
        return {"success_rate": self.rate, "interval": list(self.interval), "n_episodes": self.n}

    def __str__(self) -> str:
        low, high = self.interval
        return f"{format_percent(self.rate)} [{100 * low:.1f}, {100 * high:.1f}]"


def format_percent(rate: float) -> str:
    """Return a share as `98.7 %`."""
    return f"{100 * rate:.1f} %"


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Return the score interval (low, high) of a binomial proportion (Wilson 1927, J. Am. Stat.

    Assoc. 22, 209-212).
    """
    found = stats.binomtest(successes, n).proportion_ci(CONFIDENCE, method="wilson")
    # At the ends the formula gives the rate itself, up to rounding.
    return (0.0 if successes == 0 else float(found.low)), (
        1.0 if successes == n else float(found.high)
    )


def confidence_sequence(successes: int, n: int) -> tuple[float, float]:
    """Return (low, high) of a binomial proportion, valid at every `n` at once, whatever the
    stopping rule.

    A rate p is excluded once the likelihood of the outcomes, averaged over rates drawn from
    Beta(1/2, 1/2), is 1 / (1 - confidence) times that of p: under the true rate this ratio is a
    martingale of mean 1, so with probability `CONFIDENCE` it never exceeds that factor (Ville 1939;
    Robbins 1970, Ann. Math. Stat. 41, 1397-1409). The interval is wider than Wilson's, which is
    valid for an `n` fixed in advance.
    """
    failures = n - successes
    mixture = (
        special.betaln(successes + 0.5, failures + 0.5)
        - special.betaln(0.5, 0.5)
        + math.log1p(-CONFIDENCE)
    )

    def excess(p: float) -> float:
        return float(mixture - special.xlogy(successes, p) - special.xlog1py(failures, -p))

    def edge(low: float, high: float) -> float:
        found: Any = optimize.brentq(excess, low, high, xtol=1e-15)
        return found

    rate = min(max(successes / n, _EDGE), 1 - _EDGE)
    return (0.0 if successes == 0 else edge(1e-300, rate)), (
        1.0 if failures == 0 else edge(rate, 1 - 1e-16)
    )


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return Student's (low, high) for the mean of two or more independent `values`.

    Student (1908), Biometrika 6, 1-25. It is wide for two or three values: the factor on the
    standard error is 12.7 or 4.3, compared with 2.0 for many values.
    """
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values))
    mean = float(np.mean(values))
    return mean - half, mean + half


def paired_interval(differences: Sequence[int]) -> tuple[float, float]:
    """Return (low, high), inside [-1, 1], for the difference of two paired proportions.

    Bonett & Price (2012), Journal of Educational and Behavioral Statistics 37, 479-488: Wald's
    interval after one more pair that only the left, and one more that only the right solves.

    Args:
        differences: Right's success minus left's in each episode, -1, 0 or 1.
    """
    adjusted = [*differences, -1, 1]
    half = float(stats.norm.ppf((1 + CONFIDENCE) / 2) * stats.sem(adjusted, ddof=0))
    mean = float(np.mean(adjusted))
    return max(-1.0, mean - half), min(1.0, mean + half)


def sign_flip_exact(differences: Sequence[int]) -> float:
    """Return the two-sided p of the hypothesis that both signs of each test episode's difference
    are equally likely.

    With one training seed this is McNemar's exact test; in general it is Fisher's randomisation
    test (The Design of Experiments, 1935, section 21). Since the sign of an episode's sum is
    flipped, outcomes of different training seeds in one episode need not be independent.

    Args:
        differences: Right's successes minus left's in an episode, summed over training seeds.
    """
    # counts of the sums -total, -total + 2, ..., total of signed differences
    ways = np.array([1], dtype=object)
    for size, count in Counter(abs(d) for d in differences if d).items():
        flips = np.zeros(size * count + 1, dtype=object)
        flips[::size] = [math.comb(count, k) for k in range(count + 1)]
        ways = np.convolve(ways, flips)
    total, observed = len(ways) - 1, abs(sum(differences))
    # Integers are divided only once, so the result is exact for any count.
    return sum(
        count for place, count in enumerate(ways) if abs(2 * place - total) >= observed
    ) / sum(ways)


def format_p(p: float) -> str:
    """Return `p = 0.031`, or `p < 0.001` for smaller values."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def format_points(difference: float, interval: tuple[float, float]) -> str:
    """Return `+4.2 points [+1.1, +7.3]`."""
    low, high = interval
    return f"{100 * difference:+z.1f} points [{100 * low:+z.1f}, {100 * high:+z.1f}]"
