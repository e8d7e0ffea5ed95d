"""Intervals and tests agree with published tables, or with counting every flip of signs, and
keep their properties.
"""

import itertools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.evaluation.intervals import (
    PairCounts,
    Proportion,
    sign_flip_exact,
    wilson_interval,
)

outcomes = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=60)
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
    ("table", "low", "high"),
    [
        # Fagerland, Lydersen, Laake (2014), Statistics in Medicine 33, 2850-2875: both worked
        # examples
        ((1, 1, 7, 12), -0.507, -0.026),
        ((59, 6, 16, 80), -0.1186, -0.0046),
        # Altman et al. (2000), Statistics with Confidence, table 6.2
        ((14, 5, 0, 22), 0.011, 0.226),
    ],
)
def test_newcombes_paired_interval_agrees_with_worked_examples(
    table: tuple[int, int, int, int], low: float, high: float
):
    digits = 5e-5 if round(low, 3) != low else 5e-4
    both, only_first, only_second, neither = table
    assert PairCounts(both, only_second, only_first, neither).interval == pytest.approx(
        (low, high), abs=digits
    )


@pytest.mark.parametrize(
    ("only_a", "only_b", "p"),
    [
        (1, 7, 18 / 256),
        (0, 5, 2 / 32),
        (0, 6, 2 / 64),
        (3, 3, 1.0),
        (0, 0, 1.0),
        (10, 2, 2 * 79 / 4096),
    ],
)
def test_with_one_training_seed_the_test_is_mcnemars_with_the_exact_binomial(
    only_a: int, only_b: int, p: float
):
    assert sign_flip_exact([-1] * only_a + [1] * only_b + [0] * 3) == pytest.approx(p, rel=1e-12)


@given(outcomes)
def test_the_paired_interval_contains_the_difference_and_changes_sign_with_the_order(
    pairs: list[tuple[bool, bool]],
):
    a, b = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    forward, backward = PairCounts.of(zip(a, b, strict=True)), PairCounts.of(zip(b, a, strict=True))
    low, high = forward.interval
    assert -1 <= low <= forward.difference <= high <= 1
    assert backward.interval == pytest.approx((-high, -low), abs=1e-12)
    assert forward.difference == pytest.approx((sum(b) - sum(a)) / len(pairs))


@given(few)
def test_the_test_counts_every_way_to_flip_the_signs(differences: list[int]):
    flips = [
        sum(s * d for s, d in zip(signs, differences, strict=True))
        for signs in itertools.product((-1, 1), repeat=len(differences))
    ]
    extreme = sum(abs(total) >= abs(sum(differences)) for total in flips)
    assert sign_flip_exact(differences) == pytest.approx(extreme / len(flips), rel=1e-12)
