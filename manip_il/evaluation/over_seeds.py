"""What several training seeds say together: a mean with its t interval, and an exact test on shared episodes.

Standard library only, as in `statistics`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from statistics import fmean, stdev

from manip_il.errors import UsageError
from manip_il.evaluation.statistics import CONFIDENCE


def mean_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return Student's (low, high) of the mean of independent `values`; `UsageError` for fewer than two.

    Student (1908), Biometrika 6, 1-25. With two or three values it is wide, and honestly so: the factor on the
    standard error is 12.7 or 4.3 where many values have 2.0.
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
    low, high = 0.0, math.pi / 2  # of the angle whose tangent is t / sqrt(degrees)
    for _ in range(60):  # halves the error each time: to the last bit
        middle = (low + high) / 2
        low, high = (middle, high) if _within(middle, degrees) < confidence else (low, middle)
    return math.sqrt(degrees) * math.tan((low + high) / 2)


def sign_flip_exact(differences: Sequence[int]) -> float:
    """Return two-sided p that every difference, one a test episode, was as likely to have the other sign.

    differences: right's successes less left's in that episode, summed over training seeds. All signs are flipped at
    once, so that training seeds which share an episode need not be independent in it. With one training seed this is
    McNemar's exact test; in general Fisher's randomisation test (The Design of Experiments, 1935, section 21).
    """
    chances: dict[int, int] = {0: 1}  # sum of the signed differences -> in how many of the 2^n flips
    for size, count in Counter(abs(d) for d in differences if d).items():
        ways = {size * (2 * k - count): math.comb(count, k) for k in range(count + 1)}
        summed: Counter[int] = Counter()
        for a, ways_a in chances.items():
            for b, ways_b in ways.items():
                summed[a + b] += ways_a * ways_b
        chances = dict(summed)
    observed = abs(sum(differences))
    # Whole numbers divided once: exact at any count.
    return sum(ways for total, ways in chances.items() if abs(total) >= observed) / sum(chances.values())


def _within(angle: float, degrees: int) -> float:
    """P(|T| <= t) where tan(angle) = t / sqrt(degrees): Abramowitz & Stegun (1964), 26.7.3 and 26.7.4."""
    sine, cosine = math.sin(angle), math.cos(angle)
    odd = degrees % 2
    term = cosine if odd else 1.0
    series = 0.0 if degrees == 1 else term
    for k in range(3 if odd else 2, degrees, 2):
        term *= cosine * cosine * (k - 1) / k
        series += term
    return 2 / math.pi * (angle + sine * series) if odd else sine * series
