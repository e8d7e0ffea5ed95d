"""Intervals and tests agree with published tables, or with counting every flip of signs, and
keep their properties.
"""

import itertools
import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.evaluation.intervals import (
    Proportion,
    paired_interval,
    sign_flip_exact,
    wilson_interval,
)

few = st.lists(st.integers(-3, 3), max_size=9)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [  # Newcombe (1998), Statistics in Medicine 17, 857-872, table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_agrees_with_newcombes_table(successes: int, n: int, low: float, high: float):
    assert wilson_interval(successes, n) == pytest.approx((low, high), abs=5e-5)


def test_a_confidence_sequence_holds_at_every_look_where_wilsons_does_not():
    rng = random.Random(0)
    for p in (0.6, 0.97):
        missed = {True: 0, False: 0}
        for _ in range(100):
            successes, wrong = 0, {True: False, False: False}
            for n in range(1, 1_001):
                successes += rng.random() < p
                if n % 50 == 0:
                    for sequential in (True, False):
                        low, high = Proportion(successes, n, sequential=sequential).interval
                        wrong[sequential] |= not low <= p <= high
            for sequential in (True, False):
                missed[sequential] += wrong[sequential]
        assert missed[True] <= 5  # 5 % of 100
        assert missed[False] > 15  # peeking costs so much


@pytest.mark.parametrize(
    ("both", "only_first", "only_second", "neither"),
    # the worked examples of Fagerland, Lydersen, Laake (2014), Statistics in Medicine 33, 2850-2875
    [(1, 1, 7, 12), (59, 6, 16, 80), (0, 0, 0, 5), (30, 0, 2, 18)],
)
def test_the_paired_interval_is_walds_with_one_more_of_each_discordant_pair(
    both: int, only_first: int, only_second: int, neither: int
):
    n = both + only_first + only_second + neither + 2
    first, second = (only_first + 1) / n, (only_second + 1) / n
    half = 1.959964 * math.sqrt((first + second - (first - second) ** 2) / n)
    outcomes = [1] * only_first + [-1] * only_second + [0] * (both + neither)
    assert paired_interval(outcomes) == pytest.approx(
        (first - second - half, first - second + half), abs=1e-6
    )


def test_the_paired_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    for chances in ([0.02, 0.9, 0.08], [0.1, 0.7, 0.2], [0.3, 0.4, 0.3]):
        drawn = rng.choice([-1, 0, 1], size=(1_000, 50), p=chances)
        intervals = [paired_interval(one.tolist()) for one in drawn]
        covered = [low <= chances[2] - chances[0] <= high for low, high in intervals]
        assert 0.93 < np.mean(covered) < 0.99


@given(few)
def test_the_test_counts_every_way_to_flip_the_signs(differences: list[int]):
    flips = [
        sum(s * d for s, d in zip(signs, differences, strict=True))
        for signs in itertools.product((-1, 1), repeat=len(differences))
    ]
    extreme = sum(abs(total) >= abs(sum(differences)) for total in flips)
    assert sign_flip_exact(differences) == pytest.approx(extreme / len(flips), rel=1e-12)
