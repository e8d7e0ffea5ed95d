"""What failures are associated with: exact tests, corrected for their number, over the thirds of whatever varied."""

from dataclasses import replace
from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import ManipError
from manip_il.evaluation.episode_facts import drawn_numbers, end_of, goal_of, start_of
from manip_il.evaluation.factors import find_factors, fisher_exact, holm
from manip_il.evaluation.results import EpisodeResult

from .made_evals import made_eval, without_detail


def tables(successes: tuple[int, ...], sizes: tuple[int, ...]) -> float:
    """The same p by whole numbers: every table with these sums that is no likelier."""
    total, (a, b, c) = sum(successes), sizes
    ways = {
        (i, j): comb(a, i) * comb(b, j) * comb(c, total - i - j)
        for i in range(a + 1)
        for j in range(b + 1)
        if 0 <= total - i - j <= c
    }
    return sum(way for way in ways.values() if way <= ways[successes[:2]]) / sum(ways.values())


@st.composite
def counts(draw: st.DrawFn) -> tuple[tuple[int, ...], tuple[int, ...]]:
    sizes = tuple(draw(st.integers(0, 12)) for _ in range(3))
    return tuple(draw(st.integers(0, size)) for size in sizes), sizes


@given(counts())
def test_the_exact_test_counts_every_table(case: tuple[tuple[int, ...], tuple[int, ...]]):
    assert fisher_exact(*case) == pytest.approx(tables(*case), abs=1e-9)


def test_of_two_groups_it_is_fishers_exact_test():
    assert fisher_exact((8, 1), (10, 6)) == pytest.approx(0.034965034965)  # R: fisher.test


def test_what_is_no_table_is_refused():
    with pytest.raises(ManipError, match="2 counts of 3 groups"):
        fisher_exact((1, 2), (3, 3, 3))
    with pytest.raises(ManipError, match=r"successes \[4, 1\] of \[3, 3\]"):
        fisher_exact((4, 1), (3, 3))


def test_holm_asks_the_smallest_p_for_the_most():
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_what_failures_go_with_is_found_and_nothing_else():
    factors = find_factors(made_eval(n=240))
    assert {factor.name for factor in factors if factor.shown} == {
        "start of the object, x [m]",
        "start of the object, y [m]",
    }
    first = factors[0]
    assert first.worst == 2
    assert sum(group.success.n for group in first.groups) == 240
    assert [group.high < after.low for group, after in zip(first.groups, first.groups[1:], strict=False)] == [
        True,
        True,
    ]


def test_a_failure_in_the_middle_alone_is_seen_too():
    result = made_eval(n=240, fails=lambda _, detail: abs(detail["goal"][1]) < 0.03)
    first = find_factors(result)[0]
    assert (first.name, first.worst, first.shown) == ("goal, y [m]", 1, True)


def test_by_chance_alone_nothing_is_shown():
    assert not any(factor.shown for factor in find_factors(made_eval(n=240, fails=lambda number, _: number % 7 == 0)))


def test_a_drawn_number_counts_within_its_condition_and_only_where_it_varied():
    names = {factor.name for factor in find_factors(made_eval())}
    assert {
        "knocked: knock [m]",
        "knocked: knock_step [steps]",
        "sensing: delay [steps]",
        "sensing: colour, red",
    } <= names
    assert not any("action_noise" in name for name in names)
    assert not any("object, z" in name for name in names)


def test_equal_values_stay_in_one_third():
    delay = next(f for f in find_factors(made_eval(n=300)) if f.name == "sensing: delay [steps]")
    assert [(g.low, g.high) for g in delay.groups] == sorted({(g.low, g.high) for g in delay.groups})
    assert sum(group.success.n for group in delay.groups) == 100


def test_nothing_is_asked_where_all_or_none_failed_or_nothing_is_told():
    assert find_factors(made_eval(fails=lambda *_: False)) == ()
    assert find_factors(made_eval(fails=lambda *_: True)) == ()
    assert find_factors(without_detail(made_eval())) == ()


STRANGE = [
    {"start": 3, "goal": "far", "end": None, "drawn": [1]},
    {"start": {"object": [1, 2]}, "goal": [1, 2, float("nan")], "drawn": {"mass": None, "size": "big", "on": True}},
    {"start": {"object": None}, "goal": [True, 1, 2], "end": {"hand": "xyz"}, "drawn": {"view": {"front": None}}},
]


@pytest.mark.parametrize("detail", STRANGE)
def test_what_a_foreign_file_tells_in_another_way_counts_as_not_told(detail: dict):
    episode = EpisodeResult(1, True, True, 1, 0.0, detail=detail)
    assert (start_of(episode), goal_of(episode), end_of(episode), drawn_numbers(episode)) == (None, None, None, {})


def test_vectors_are_told_by_their_parts_or_their_length():
    drawn = {"colour": [0.1, 0.2, 0.3], "camera_shift": {"front": [0.0, 0.03, 0.04]}, "wind": [3, 4]}
    episode = replace(made_eval(n=1).episodes[0], detail={"drawn": drawn})
    assert drawn_numbers(episode) == pytest.approx(
        {
            "colour, red": 0.1,
            "colour, green": 0.2,
            "colour, blue": 0.3,
            "camera_shift front [m]": 0.05,
            "wind, length": 5,
        }
    )
