"""Intervals and tests over training seeds agree with published tables and with counting everything."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import UsageError
from manip_il.evaluation.over_seeds import mean_interval, sign_flip_exact, t_quantile
from manip_il.evaluation.statistics import mcnemar_exact_counts

few = st.lists(st.integers(-3, 3), max_size=9)
rates = st.lists(st.floats(-1, 1), min_size=2, max_size=8)


@pytest.mark.parametrize(
    ("confidence", "degrees", "t"),
    [  # Abramowitz & Stegun (1964), table 26.10
        (0.95, 1, 12.706),
        (0.95, 2, 4.303),
        (0.95, 4, 2.776),
        (0.99, 3, 5.841),
        (0.99, 10, 3.169),
        (0.90, 7, 1.895),
        (0.95, 120, 1.980),
    ],
)
def test_t_agrees_with_the_table(confidence: float, degrees: int, t: float):
    assert t_quantile(confidence, degrees) == pytest.approx(t, abs=5e-4)


def test_with_one_degree_of_freedom_t_is_cauchys():
    assert t_quantile(0.8, 1) == pytest.approx(math.tan(0.8 * math.pi / 2), rel=1e-12)


def test_the_interval_of_a_mean_worked_by_hand():
    low, high = mean_interval([0.01, 0.02, 0.03])
    assert (low, high) == pytest.approx(
        (0.02 - 4.3027 * 0.01 / math.sqrt(3), 0.02 + 4.3027 * 0.01 / math.sqrt(3)), 1e-4
    )


@given(rates)
def test_the_interval_contains_the_mean_and_turns_with_the_sign(values: list[float]):
    low, high = mean_interval(values)
    assert low <= sum(values) / len(values) + 1e-12
    assert mean_interval([-value for value in values]) == pytest.approx((-high, -low), abs=1e-9)


def test_one_training_seed_has_no_interval():
    with pytest.raises(UsageError, match="1 training seed"):
        mean_interval([0.1])


@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 40))
def test_with_one_training_seed_the_test_is_mcnemars(only_left: int, only_right: int, same: int):
    differences = [-1] * only_left + [1] * only_right + [0] * same
    assert sign_flip_exact(differences) == pytest.approx(mcnemar_exact_counts(only_left, only_right), rel=1e-12)


@given(few)
def test_the_test_counts_every_way_to_flip_the_signs(differences: list[int]):
    flips = [sum(s * d for s, d in zip(signs, differences, strict=True)) for signs in _signs(len(differences))]
    extreme = sum(abs(total) >= abs(sum(differences)) for total in flips)
    assert sign_flip_exact(differences) == pytest.approx(extreme / len(flips), rel=1e-12)


@given(few)
def test_training_seeds_that_agree_in_every_episode_are_no_further_evidence(differences: list[int]):
    assert sign_flip_exact([3 * d for d in differences]) == sign_flip_exact(differences)


def _signs(count: int) -> list[tuple[int, ...]]:
    return list(itertools.product((-1, 1), repeat=count))
