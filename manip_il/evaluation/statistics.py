"""How sure a success rate is, and whether one policy beats another on the same seeds.

Standard library only: intervals by the score method, or by a betting argument where one looks again and again; tests
by the exact binomial.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

from manip_il.errors import ManipError, UsageError

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Proportion:
    """`successes` of `n` trials with Wilson's interval; prints as `98.7 % [97.8, 99.3]`.

    sequential: `n` depended on what was seen so far, so the interval is one that holds at any time one looks.
    """

    successes: int
    n: int
    confidence: float = CONFIDENCE
    sequential: bool = False

    def __post_init__(self) -> None:
        _require_counts(self.successes, self.n)
        _require_confidence(self.confidence)

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
        return f"{100 * self.rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """Two policies on the same `n` episodes, counted by who succeeded.

    difference: rate of `right` minus rate of `left`; interval: Newcombe's, paired.
    p_value: McNemar's exact test, two-sided.
    """

    left: str
    right: str
    both: int
    only_left: int
    only_right: int
    neither: int
    confidence: float = CONFIDENCE

    @property
    def n(self) -> int:
        """Pairs."""
        return self.both + self.only_left + self.only_right + self.neither

    @property
    def left_rate(self) -> Proportion:
        """The first policy's success."""
        return Proportion(self.both + self.only_left, self.n, self.confidence)

    @property
    def right_rate(self) -> Proportion:
        """The second policy's success."""
        return Proportion(self.both + self.only_right, self.n, self.confidence)

    @property
    def difference(self) -> float:
        """Rate of the second minus rate of the first, in [-1, 1]."""
        return (self.only_right - self.only_left) / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Newcombe's (low, high) of `difference`."""
        return paired_difference_interval(self.both, self.only_right, self.only_left, self.neither, self.confidence)

    @property
    def p_value(self) -> float:
        """McNemar's exact two-sided p."""
        return mcnemar_exact_counts(self.only_left, self.only_right)

    @property
    def significant(self) -> bool:
        """Whether the exact test rejects "equally good" at the level of `confidence`."""
        return self.p_value < 1 - self.confidence

    @property
    def verdict(self) -> str:
        """One sentence in words, with the numbers that carry it."""
        low, high = self.interval
        numbers = (
            f"{100 * self.difference:+.1f} points [{100 * low:+.1f}, {100 * high:+.1f}], "
            f"McNemar's exact {format_p(self.p_value)}, {self.n:,} paired episodes"
        )
        if self.significant:
            better, worse = (self.right, self.left) if self.difference > 0 else (self.left, self.right)
            return f"{better} beats {worse}: {numbers}."
        if self.only_left == self.only_right == 0:
            return f"{self.right} and {self.left} succeeded in exactly the same episodes: {numbers}."
        return f"No difference shown between {self.right} and {self.left}: {numbers}."


def wilson_interval(successes: int, n: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Score interval (low, high) of a binomial proportion, inside [0, 1].

    Wilson (1927), J. Am. Stat. Assoc. 22, 209-212. Raises `UsageError` unless 0 <= successes <= n and n >= 1.
    """
    _require_counts(successes, n)
    z = _z(confidence)
    rate = successes / n
    denominator = 1 + z * z / n
    centre = (rate + z * z / (2 * n)) / denominator
    half = z / denominator * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # At the ends the formula gives the rate itself: say so exactly, free of rounding.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == n else min(1.0, centre + half)
    return low, high


def confidence_sequence(successes: int, n: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """(low, high) of a binomial proportion that holds at every `n` at once, however one decides when to stop.

    A rate p is left out once the likelihood of what was seen, averaged over rates drawn from Beta(1/2, 1/2), is
    1 / (1 - confidence) times that of p: under the true rate this ratio is a martingale of mean 1, so with probability
    `confidence` it never gets there (Ville 1939; Robbins 1970, Ann. Math. Stat. 41, 1397-1409). Wider than Wilson's,
    which holds for an `n` that was fixed before. Raises `UsageError` as `wilson_interval` does.
    """
    _require_counts(successes, n)
    _require_confidence(confidence)
    failures = n - successes
    mixture = _log_beta(successes + 0.5, failures + 0.5) - _log_beta(0.5, 0.5)

    def inside(p: float) -> bool:
        log_likelihood = (successes * math.log(p) if successes else 0.0) + (
            failures * math.log1p(-p) if failures else 0.0
        )
        return mixture - log_likelihood < -math.log1p(-confidence)

    rate = successes / n
    low = 0.0 if successes == 0 else _edge(inside, rate, 0.0)
    high = 1.0 if failures == 0 else _edge(inside, rate, 1.0)
    return low, high


def mcnemar_exact(a: Sequence[bool], b: Sequence[bool]) -> float:
    """Return two-sided p that `a` and `b`, paired outcomes on the same seeds, have one success rate.

    McNemar (1947), Psychometrika 12, 153-157, with the exact binomial in place of chi-square.
    """
    comparison = compare_paired(a, b)
    return comparison.p_value


def mcnemar_exact_counts(only_a: int, only_b: int) -> float:
    """`mcnemar_exact` from the numbers of pairs in which just one succeeded."""
    discordant = only_a + only_b
    tail = sum(math.comb(discordant, k) for k in range(min(only_a, only_b) + 1))
    # Whole numbers divided once: exact to the last bit, and no overflow at any count.
    return min(1.0, 2 * tail / 2**discordant)


def paired_difference_interval(
    both: int, only_first: int, only_second: int, neither: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """(low, high) of the rate of the first minus the rate of the second, paired, inside [-1, 1].

    Newcombe (1998), Statistics in Medicine 17, 2635-2650, method 10: Wilson's limits of both
    rates, squared and added, less their correlation with a continuity correction.
    """
    n = both + only_first + only_second + neither
    first, second = both + only_first, both + only_second
    _require_counts(min(both, only_first, only_second, neither), n)
    p1, p2 = first / n, second / n
    l1, u1 = wilson_interval(first, n, confidence)
    l2, u2 = wilson_interval(second, n, confidence)
    phi = _corrected_phi(both, only_first, only_second, neither)
    difference = (only_first - only_second) / n
    below = _square_and_add(p1 - l1, u2 - p2, phi)
    above = _square_and_add(u1 - p1, p2 - l2, phi)
    return max(-1.0, difference - below), min(1.0, difference + above)


def compare_paired(
    left: Sequence[bool],
    right: Sequence[bool],
    names: tuple[str, str] = ("A", "B"),
    confidence: float = CONFIDENCE,
) -> PairedComparison:
    """Compare outcomes that belong together by position; `ManipError` where lengths differ or are 0."""
    if len(left) != len(right):
        raise ManipError(
            f"paired comparison of {len(left)} episodes of {names[0]} with {len(right)} of {names[1]}; "
            "both must hold the same seeds in the same order"
        )
    if len(left) == 0:
        raise ManipError(f"no episodes to compare {names[0]} with {names[1]} on")
    _require_confidence(confidence)
    pairs = [(bool(a), bool(b)) for a, b in zip(left, right, strict=True)]
    return PairedComparison(
        left=names[0],
        right=names[1],
        both=pairs.count((True, True)),
        only_left=pairs.count((True, False)),
        only_right=pairs.count((False, True)),
        neither=pairs.count((False, False)),
        confidence=confidence,
    )


def format_p(p: float) -> str:
    """`p = 0.031`, or `p < 0.001` where more digits would say nothing."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _edge(inside: Callable[[float], bool], within: float, outside: float) -> float:
    """Where `inside` ends on the way from a point within to one outside; the point outside never counts as within."""
    # The rate itself can be 0 or 1, where there is no logarithm: its neighbour is always within.
    within = min(max(within, 1e-12), 1 - 1e-12)
    for _ in range(60):  # halves the error each time: to the last bit
        middle = (within + outside) / 2
        within, outside = (middle, outside) if inside(middle) else (within, middle)
    return (within + outside) / 2


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def _corrected_phi(both: int, only_first: int, only_second: int, neither: int) -> float:
    n = both + only_first + only_second + neither
    margins = (both + only_first) * (only_second + neither) * (both + only_second) * (only_first + neither)
    if margins == 0:
        return 0.0
    cross = both * neither - only_first * only_second
    if cross > 0:  # the correction draws a positive correlation towards none, never past it
        cross = max(cross - n / 2, 0.0)
    return cross / math.sqrt(margins)


def _square_and_add(a: float, b: float, phi: float) -> float:
    return math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b))


def _z(confidence: float) -> float:
    _require_confidence(confidence)
    return NormalDist().inv_cdf((1 + confidence) / 2)


def _require_counts(successes: int, n: int) -> None:
    if n < 1 or not 0 <= successes <= n:
        raise UsageError(f"{successes} successes of {n} trials; expected 0 <= successes <= n and n >= 1")


def _require_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise UsageError(f"confidence is {confidence}; expected a number between 0 and 1, such as 0.95")
