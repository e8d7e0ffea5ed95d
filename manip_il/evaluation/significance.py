"""Exact tests of success counts: two policies on the same seeds, several training seeds, groups of episodes."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.evaluation.intervals import CONFIDENCE, require_confidence, require_counts, wilson_interval
from manip_il.mdp import F64

_EQUALLY_LIKELY = 1e-7  # tables whose log-probabilities differ by less are equally likely: rounding


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """Two policies on the same `n` episodes, counted by who succeeded."""

    left: str
    right: str
    both: int
    only_left: int
    only_right: int
    neither: int
    confidence: float = CONFIDENCE

    @property
    def n(self) -> int:
        """Number of pairs."""
        return self.both + self.only_left + self.only_right + self.neither

    @property
    def difference(self) -> float:
        """Rate of `right` minus rate of `left`, in [-1, 1]."""
        return (self.only_right - self.only_left) / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Newcombe's (low, high) of `difference`."""
        return paired_difference_interval(self.both, self.only_right, self.only_left, self.neither, self.confidence)

    @property
    def p_value(self) -> float:
        """McNemar's exact two-sided p."""
        return mcnemar_exact(self.only_left, self.only_right)

    @property
    def significant(self) -> bool:
        """Whether the exact test rejects "equally good" at the level of `confidence`."""
        return self.p_value < 1 - self.confidence

    @property
    def verdict(self) -> str:
        """One sentence with the difference, its interval and p."""
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


def compare_paired(
    left: Sequence[bool],
    right: Sequence[bool],
    names: tuple[str, str] = ("A", "B"),
    confidence: float = CONFIDENCE,
) -> PairedComparison:
    """Compare outcomes that are paired by position; `ManipError` where lengths differ or are 0."""
    if len(left) != len(right):
        raise ManipError(
            f"paired comparison of {len(left)} episodes of {names[0]} with {len(right)} of {names[1]}; "
            "both must hold the same seeds in the same order"
        )
    if len(left) == 0:
        raise ManipError(f"no episodes to compare {names[0]} with {names[1]} on")
    require_confidence(confidence)
    pairs = Counter((bool(a), bool(b)) for a, b in zip(left, right, strict=True))
    return PairedComparison(
        *names,
        both=pairs[True, True],
        only_left=pairs[True, False],
        only_right=pairs[False, True],
        neither=pairs[False, False],
        confidence=confidence,
    )


def mcnemar_exact(only_left: int, only_right: int) -> float:
    """Return two-sided p that two policies have one success rate, from the pairs in which just one succeeded.

    McNemar (1947), Psychometrika 12, 153-157, with the exact binomial in place of chi-square.
    """
    discordant = only_left + only_right
    tail = sum(math.comb(discordant, k) for k in range(min(only_left, only_right) + 1))
    # Whole numbers divided once: exact to the last bit, and no overflow at any count.
    return min(1.0, 2 * tail / 2**discordant)


def paired_difference_interval(
    both: int, only_first: int, only_second: int, neither: int, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return (low, high) of the rate of the first minus the rate of the second, paired, inside [-1, 1].

    Newcombe (1998), Statistics in Medicine 17, 2635-2650, method 10: Wilson's limits of both
    rates, squared and added, less their correlation with a continuity correction.
    """
    n = both + only_first + only_second + neither
    first, second = both + only_first, both + only_second
    require_counts(min(both, only_first, only_second, neither), n)
    p1, p2 = first / n, second / n
    l1, u1 = wilson_interval(first, n, confidence)
    l2, u2 = wilson_interval(second, n, confidence)
    phi = _corrected_phi(both, only_first, only_second, neither)
    difference = (only_first - only_second) / n
    below = _square_and_add(p1 - l1, u2 - p2, phi)
    above = _square_and_add(u1 - p1, p2 - l2, phi)
    return max(-1.0, difference - below), min(1.0, difference + above)


def sign_flip_exact(differences: Sequence[int]) -> float:
    """Return two-sided p that every difference, one a test episode, was as likely to have the other sign.

    differences: right's successes less left's in that episode, summed over training seeds. The seeds' signs are flipped
    together, so that training seeds which share an episode need not be independent in it. With one training seed this
    is McNemar's exact test; in general Fisher's randomisation test (The Design of Experiments, 1935, section 21).
    """
    ways: dict[int, int] = {0: 1}  # sum of the signed differences -> in how many of the 2^n flips
    for size, count in Counter(abs(d) for d in differences if d).items():
        flips = {size * (2 * k - count): math.comb(count, k) for k in range(count + 1)}
        summed: Counter[int] = Counter()
        for (a, ways_a), (b, ways_b) in itertools.product(ways.items(), flips.items()):
            summed[a + b] += ways_a * ways_b
        ways = dict(summed)
    observed = abs(sum(differences))
    # Whole numbers divided once: exact at any count.
    return sum(count for total, count in ways.items() if abs(total) >= observed) / sum(ways.values())


def fisher_exact(successes: Sequence[int], sizes: Sequence[int]) -> float:
    """Return two-sided p that two or three groups have one success rate, by all tables with the same sums.

    Freeman and Halton (1951), Biometrika 38, 141-149; of two groups it is Fisher's exact test. Raises `ManipError` for
    another number of groups, or impossible counts.
    """
    if len(successes) != len(sizes) or len(sizes) not in (2, 3):
        raise ManipError(f"{len(successes)} counts of {len(sizes)} groups; expected two or three groups")
    if not all(0 <= count <= size for count, size in zip(successes, sizes, strict=True)):
        raise ManipError(f"successes {list(successes)} of {list(sizes)}; expected 0 to as many as there are")
    (a, b, c), total = (*sizes, 0)[:3], sum(successes)
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, sum(sizes) + 1)))])

    def log_ways(n: int, k: NDArray[np.int64]) -> F64:
        return log_factorial[n] - log_factorial[k] - log_factorial[n - k]

    observed = sum(float(log_ways(n, np.array([k]))[0]) for n, k in zip(sizes, successes, strict=True))
    every = float(log_ways(sum(sizes), np.array([total]))[0])
    likely = 0.0
    for first in range(max(0, total - b - c), min(a, total) + 1):
        rest = total - first
        second = np.arange(max(0, rest - c), min(b, rest) + 1, dtype=np.int64)
        ways = log_ways(a, np.array([first])) + log_ways(b, second) + log_ways(c, rest - second)
        likely += float(np.exp(ways[ways <= observed + _EQUALLY_LIKELY] - every).sum())
    return min(1.0, likely)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return every p corrected for how many there are: Holm (1979), Scand. J. Statist. 6, 65-70."""
    ranks = np.argsort(p_values, kind="stable")
    scaled = np.array(p_values)[ranks] * np.arange(len(p_values), 0, -1)
    corrected = np.empty(len(p_values))
    corrected[ranks] = np.minimum(1.0, np.maximum.accumulate(scaled))
    return corrected.tolist()


def format_p(p: float) -> str:
    """Return `p = 0.031`, or `p < 0.001` for what is smaller."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def format_p_cell(p: float) -> str:
    """Return `0.031` or `< 0.001`, for a column that is headed p."""
    return format_p(p).removeprefix("p ").removeprefix("= ")


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
