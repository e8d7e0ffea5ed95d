"""Tests agree with published examples and with counting every table or every flip of signs."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.evaluation.intervals import PairedComparison, compare_paired, format_p, sign_flip_exact

outcomes = st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=60)
few = st.lists(st.integers(-3, 3), max_size=9)


def mcnemar(only_left: int, only_right: int) -> float:
    return PairedComparison("A", "B", 0, only_left, only_right, 1).p_value


@pytest.mark.parametrize(
    ("only_a", "only_b", "p"),
    [(1, 7, 18 / 256), (0, 5, 2 / 32), (0, 6, 2 / 64), (3, 3, 1.0), (0, 0, 1.0), (10, 2, 2 * 79 / 4096)],
)
def test_mcnemar_is_the_exact_binomial(only_a: int, only_b: int, p: float):
    assert mcnemar(only_a, only_b) == pytest.approx(p, rel=1e-12)


@given(outcomes)
def test_mcnemar_is_a_probability_and_symmetric(pairs: list[tuple[bool, bool]]):
    a, b = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    assert 0 < compare_paired(a, b).p_value <= 1
    assert compare_paired(a, b).p_value == compare_paired(b, a).p_value
    assert compare_paired(a, a).p_value == 1


def test_mcnemar_survives_counts_beyond_floating_point():
    assert 0 < mcnemar(1_000, 1_100) < 1  # 2 to the 2100: a float ends at 2 to the 1024


@given(outcomes)
def test_the_paired_interval_contains_the_difference_and_changes_sign_with_the_order(pairs: list[tuple[bool, bool]]):
    a, b = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    forward, backward = compare_paired(a, b), compare_paired(b, a)
    low, high = forward.interval
    assert -1 <= low <= forward.difference <= high <= 1
    assert backward.interval == pytest.approx((-high, -low), abs=1e-12)
    assert forward.difference == pytest.approx((sum(b) - sum(a)) / len(pairs))


def test_the_verdict_names_the_better_policy_and_its_margin():
    left, right = [True] * 60 + [False] * 40, [True] * 100
    verdict = compare_paired(left, right, ("BC", "DAgger")).verdict
    assert verdict.startswith("DAgger beats BC: +40.0 points")
    assert "p < 0.001" in verdict
    assert compare_paired(right, left, ("DAgger", "BC")).verdict.startswith("DAgger beats BC: -40.0 points")


def test_without_a_significant_difference_the_verdict_says_so():
    verdict = compare_paired([True, False, True], [True, True, True], ("BC", "DAgger")).verdict
    assert verdict.startswith("No difference shown between DAgger and BC")
    assert "exactly the same episodes" in compare_paired([True, False], [True, False]).verdict


def test_p_values_read_well():
    assert format_p(0.03125) == "p = 0.031"
    assert format_p(1e-9) == "p < 0.001"


@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 40))
def test_with_one_training_seed_the_test_is_mcnemars(only_left: int, only_right: int, same: int):
    differences = [-1] * only_left + [1] * only_right + [0] * same
    assert sign_flip_exact(differences) == pytest.approx(mcnemar(only_left, only_right), rel=1e-12)


@given(few)
def test_the_test_counts_every_way_to_flip_the_signs(differences: list[int]):
    flips = [
        sum(s * d for s, d in zip(signs, differences, strict=True))
        for signs in itertools.product((-1, 1), repeat=len(differences))
    ]
    extreme = sum(abs(total) >= abs(sum(differences)) for total in flips)
    assert sign_flip_exact(differences) == pytest.approx(extreme / len(flips), rel=1e-12)


@given(few)
def test_training_seeds_that_agree_in_every_episode_are_no_further_evidence(differences: list[int]):
    assert sign_flip_exact([3 * d for d in differences]) == sign_flip_exact(differences)
