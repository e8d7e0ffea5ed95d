"""Exact tests of success counts: two policies on the same seeds, with one training seed or several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from scipy import stats

from manip_il.errors import ManipError
from manip_il.evaluation.intervals import CONFIDENCE, paired_difference_interval


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """Two policies on the same `n` episodes, counted by who succeeded."""

    left: str
    right: str
    both: int
    only_left: int
    only_right: int
    neither: int

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
        return paired_difference_interval(self.both, self.only_right, self.only_left, self.neither)

    @property
    def p_value(self) -> float:
        """McNemar's exact two-sided p."""
        return mcnemar_exact(self.only_left, self.only_right)

    @property
    def significant(self) -> bool:
        """Whether the exact test rejects "equally good"."""
        return self.p_value < 1 - CONFIDENCE

    @property
    def verdict(self) -> str:
        """One sentence with the difference, its interval and p."""
        numbers = (
            f"{format_points(self.difference, self.interval)}, McNemar's exact {format_p(self.p_value)}, "
            f"{self.n:,} paired episodes"
        )
        if self.significant:
            better, worse = (self.right, self.left) if self.difference > 0 else (self.left, self.right)
            return f"{better} beats {worse}: {numbers}."
        if self.only_left == self.only_right == 0:
            return f"{self.right} and {self.left} succeeded in exactly the same episodes: {numbers}."
        return f"No difference shown between {self.right} and {self.left}: {numbers}."


def compare_paired(
    left: Sequence[bool], right: Sequence[bool], names: tuple[str, str] = ("A", "B")
) -> PairedComparison:
    """Compare outcomes that are paired by position; `ManipError` if lengths differ or are 0."""
    if len(left) != len(right) or not left:
        raise ManipError(
            f"paired comparison of {len(left)} episodes of {names[0]} with {len(right)} of {names[1]}; "
            "both must hold the same seeds in the same order, and at least one"
        )
    pairs = Counter((bool(a), bool(b)) for a, b in zip(left, right, strict=True))
    return PairedComparison(*names, pairs[True, True], pairs[True, False], pairs[False, True], pairs[False, False])


def mcnemar_exact(only_left: int, only_right: int) -> float:
    """Return two-sided p that two policies have one success rate, from the pairs in which just one succeeded.

    McNemar (1947), Psychometrika 12, 153-157, with the exact binomial in place of chi-square.
    """
    discordant = only_left + only_right
    return float(stats.binomtest(only_left, discordant).pvalue) if discordant else 1.0


def sign_flip_exact(differences: Sequence[int]) -> float:
    """Return two-sided p that every difference, one a test episode, was as likely to have the other sign.

    differences: right's successes less left's in that episode, summed over training seeds. The seeds' signs are flipped
    together, so that training seeds which share an episode need not be independent in it. With one training seed this
    is McNemar's exact test; in general Fisher's randomisation test (The Design of Experiments, 1935, section 21).
    """
    ways = np.array([1], dtype=object)  # of the sums -total, -total + 2, ..., total of the signed differences
    for size, count in Counter(abs(d) for d in differences if d).items():
        flips = np.zeros(size * count + 1, dtype=object)
        flips[::size] = [comb(count, k) for k in range(count + 1)]
        ways = np.convolve(ways, flips)
    total, observed = len(ways) - 1, abs(sum(differences))
    # Whole numbers divided once: exact at any count.
    return sum(count for place, count in enumerate(ways) if abs(2 * place - total) >= observed) / sum(ways)


def format_p(p: float) -> str:
    """Return `p = 0.031`, or `p < 0.001` for what is smaller."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def format_points(difference: float, interval: tuple[float, float]) -> str:
    """Return `+4.2 points [+1.1, +7.3]`."""
    low, high = interval
    return f"{100 * difference:+z.1f} points [{100 * low:+z.1f}, {100 * high:+z.1f}]"
