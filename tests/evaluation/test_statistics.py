"""Intervals and tests agree with published tables and keep their defining properties."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.statistics import (
    Proportion,
    compare_paired,
    confidence_sequence,
    format_p,
    mcnemar_exact,
    mcnemar_exact_counts,
    paired_difference_interval,
    wilson_interval,
)

counts = st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))
outcomes = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=60)
confidences = st.sampled_from([0.5, 0.8, 0.9, 0.95, 0.99])


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


@given(counts, confidences)
def test_wilson_contains_the_rate_and_stays_in_the_unit_interval(count: tuple[int, int], confidence: float):
    successes, n = count
    low, high = wilson_interval(successes, n, confidence)
    assert 0 <= low <= successes / n <= high <= 1
    assert low < high


@given(counts, confidences)
def test_wilson_of_failures_mirrors_that_of_successes(count: tuple[int, int], confidence: float):
    successes, n = count
    low, high = wilson_interval(successes, n, confidence)
    mirrored = wilson_interval(n - successes, n, confidence)
    assert mirrored == pytest.approx((1 - high, 1 - low), abs=1e-12)


@given(counts)
def test_wilson_limits_are_where_the_score_test_just_rejects(count: tuple[int, int]):
    """The definition, Wilson (1927): |rate - p| = z sqrt(p (1 - p) / n) at both ends."""
    successes, n = count
    for limit in wilson_interval(successes, n):
        if 0 < limit < 1:
            score = abs(successes / n - limit) / math.sqrt(limit * (1 - limit) / n)
            assert score == pytest.approx(1.959964, abs=1e-5)


@given(counts)
def test_more_confidence_is_a_wider_interval(count: tuple[int, int]):
    low, high = wilson_interval(*count, confidence=0.9)
    lower, higher = wilson_interval(*count, confidence=0.99)
    assert lower <= low
    assert high <= higher


def test_a_proportion_prints_its_interval():
    assert str(Proportion(987, 1000)) == "98.7 % [97.8, 99.2]"
    assert str(Proportion.of([True, False])) == "50.0 % [9.5, 90.5]"


@pytest.mark.parametrize(("successes", "n"), [(1, 0), (-1, 5), (6, 5), (0, 0)])
def test_impossible_counts_are_refused_with_both_numbers(successes: int, n: int):
    with pytest.raises(UsageError, match=f"{successes} successes of {n}"):
        Proportion(successes, n)


def test_a_confidence_in_percent_is_refused():
    with pytest.raises(UsageError, match="confidence is 95"):
        wilson_interval(1, 2, confidence=95)


@pytest.mark.parametrize(
    ("only_a", "only_b", "p"),
    [(1, 7, 18 / 256), (0, 5, 2 / 32), (0, 6, 2 / 64), (3, 3, 1.0), (0, 0, 1.0), (10, 2, 2 * 79 / 4096)],
)
def test_mcnemar_is_the_exact_binomial(only_a: int, only_b: int, p: float):
    assert mcnemar_exact_counts(only_a, only_b) == pytest.approx(p, rel=1e-12)


@given(outcomes)
def test_mcnemar_is_a_probability_and_symmetric(pairs: list[tuple[bool, bool]]):
    a, b = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    assert 0 < mcnemar_exact(a, b) <= 1
    assert mcnemar_exact(a, b) == mcnemar_exact(b, a)
    assert mcnemar_exact(a, a) == 1


def test_mcnemar_survives_counts_beyond_floating_point():
    assert 0 < mcnemar_exact_counts(1_000, 1_100) < 1  # 2 to the 2100: a float ends at 2 to the 1024


@pytest.mark.parametrize(
    ("table", "low", "high"),
    [
        # Fagerland, Lydersen, Laake (2014), Statistics in Medicine 33, 2850-2875: both worked examples
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
    assert paired_difference_interval(*table) == pytest.approx((low, high), abs=digits)


@given(outcomes, confidences)
def test_the_paired_interval_contains_the_difference_and_changes_sign_with_the_order(
    pairs: list[tuple[bool, bool]], confidence: float
):
    a, b = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    forward, backward = compare_paired(a, b, confidence=confidence), compare_paired(b, a, confidence=confidence)
    low, high = forward.interval
    assert -1 <= low <= forward.difference <= high <= 1
    assert backward.interval == pytest.approx((-high, -low), abs=1e-12)
    assert forward.difference == pytest.approx(forward.right_rate.rate - forward.left_rate.rate)


def test_the_verdict_names_the_better_policy_and_its_margin():
    left, right = [True] * 60 + [False] * 40, [True] * 100
    verdict = compare_paired(left, right, ("BC", "DAgger")).verdict
    assert verdict.startswith("DAgger beats BC: +40.0 points")
    assert "p < 0.001" in verdict
    assert compare_paired(right, left, ("DAgger", "BC")).verdict.startswith("DAgger beats BC: -40.0 points")


def test_a_small_difference_is_not_called_one():
    verdict = compare_paired([True, False, True], [True, True, True], ("BC", "DAgger")).verdict
    assert verdict.startswith("No difference shown between DAgger and BC")


def test_equal_outcomes_are_called_equal():
    assert "exactly the same episodes" in compare_paired([True, False], [True, False]).verdict


def test_unpaired_lengths_are_refused_with_both():
    with pytest.raises(ManipError, match=r"2 episodes of A with 1 of B"):
        compare_paired([True, False], [True])
    with pytest.raises(ManipError, match="no episodes"):
        compare_paired([], [])


def test_p_values_read_well():
    assert format_p(0.03125) == "p = 0.031"
    assert format_p(1e-9) == "p < 0.001"


def test_a_confidence_sequence_holds_at_every_look_where_wilsons_does_not():
    rng = random.Random(0)
    for p in (0.6, 0.97):
        missed = {True: 0, False: 0}
        for _ in range(200):
            successes, wrong = 0, {True: False, False: False}
            for n in range(1, 1_501):
                successes += rng.random() < p
                if n % 50 == 0:
                    for sequential in (True, False):
                        low, high = Proportion(successes, n, sequential=sequential).interval
                        wrong[sequential] |= not low <= p <= high
            for sequential in (True, False):
                missed[sequential] += wrong[sequential]
        assert missed[True] <= 10  # 5 % of 200
        assert missed[False] > 30  # peeking costs so much


@pytest.mark.parametrize("n", [1, 10, 1_000])
def test_a_confidence_sequence_contains_the_rate_and_wilsons_interval_nearly(n):
    for successes in {0, n // 2, n - 1, n}:
        low, high = confidence_sequence(successes, n)
        assert 0 <= low <= successes / n <= high <= 1
        ours, theirs = high - low, wilson_interval(successes, n)
        assert ours > 0.9 * (theirs[1] - theirs[0])
    assert confidence_sequence(0, n)[0] == 0.0
    assert confidence_sequence(n, n)[1] == 1.0


def test_a_confidence_sequence_is_symmetric_and_narrows():
    for successes, n in ((3, 10), (99, 100), (0, 7)):
        low, high = confidence_sequence(successes, n)
        assert confidence_sequence(n - successes, n) == pytest.approx((1 - high, 1 - low), abs=1e-9)
    widths = [high - low for low, high in (confidence_sequence(9 * k, 10 * k) for k in (1, 10, 100, 1_000))]
    assert widths == sorted(widths, reverse=True)


def test_the_edge_of_a_confidence_sequence_is_where_the_bet_reaches_twenty():
    successes, n = 45, 50
    grid = [(i + 0.5) / 20_000 for i in range(20_000)]
    # The mixture by a sum over rates in place of the beta function: another way to the same ratio.
    prior = [1 / math.sqrt(p * (1 - p)) for p in grid]
    likelihood = [p**successes * (1 - p) ** (n - successes) for p in grid]
    mixture = sum(w * x for w, x in zip(prior, likelihood, strict=True)) / sum(prior)
    for edge in confidence_sequence(successes, n):
        assert mixture / (edge**successes * (1 - edge) ** (n - successes)) == pytest.approx(20, rel=0.01)
