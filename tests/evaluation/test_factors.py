"""Failures are associated with what they depend on, and with nothing else."""

from dataclasses import replace
from itertools import pairwise

import pytest

from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.failures import find_factors

from .made_evals import made_eval, without_detail


def test_what_failures_depend_on_is_found_and_nothing_else():
    factors = find_factors(made_eval(n=240))
    assert {factor.name for factor in factors if factor.significant} == {
        "start of the object, x [m]",
        "start of the object, y [m]",
    }
    first = factors[0]
    assert first.worst == 2
    assert sum(one.success.n for one in first.bins) == 240
    assert all(one.high < after.low for one, after in pairwise(first.bins))


def test_a_failure_in_the_middle_alone_is_seen_too():
    result = made_eval(n=240, fails=lambda _, detail: abs(detail["goal"][1]) < 0.03)
    first = find_factors(result)[0]
    assert (first.name, first.worst, first.significant) == ("goal, y [m]", 1, True)


def test_by_chance_alone_nothing_is_shown():
    factors = find_factors(made_eval(n=240, fails=lambda number, _: number % 7 == 0))
    assert not any(factor.significant for factor in factors)


def test_a_drawn_number_counts_within_its_condition_and_only_where_it_varied():
    names = {factor.name for factor in find_factors(made_eval())}
    drawn = {"knocked: knock [m]", "knocked: knock_step [steps]", "sensing: delay [steps]", "sensing: colour, red"}
    assert drawn <= names
    assert not any("action_noise" in name for name in names)
    assert not any("object, z" in name for name in names)


def test_equal_values_stay_in_one_third():
    delay = next(f for f in find_factors(made_eval(n=300)) if f.name == "sensing: delay [steps]")
    assert [(g.low, g.high) for g in delay.bins] == sorted({(g.low, g.high) for g in delay.bins})
    assert sum(one.success.n for one in delay.bins) == 100


def test_there_are_no_factors_where_all_or_none_failed_or_nothing_is_recorded():
    assert find_factors(made_eval(fails=lambda *_: False)) == ()
    assert find_factors(made_eval(fails=lambda *_: True)) == ()
    assert find_factors(without_detail(made_eval())) == ()


@pytest.mark.parametrize(
    "detail",
    [
        {"start": 3, "goal": "far", "end": None, "drawn": [1]},
        {"start": {"object": [1, 2]}, "goal": [1, 2, float("nan")], "drawn": {"mass": None, "size": "big", "on": True}},
        {"start": {"object": None}, "goal": [True, 1, 2], "end": {"hand": "xyz"}, "drawn": {"view": {"front": None}}},
    ],
)
def test_detail_of_another_kind_in_a_foreign_file_is_ignored(detail: dict):
    episode = EpisodeResult(1, True, True, 1, 0.0, detail=detail)
    assert (episode.start, episode.goal, episode.end, episode.drawn_numbers) == (None, None, None, {})


def test_vectors_count_by_their_components_or_their_length():
    drawn = {"colour": [0.1, 0.2, 0.3], "camera_shift": {"front": [0.0, 0.03, 0.04]}, "wind": [3, 4]}
    episode = replace(made_eval(n=1).episodes[0], detail={"drawn": drawn})
    colours = {"colour, red": 0.1, "colour, green": 0.2, "colour, blue": 0.3}
    assert episode.drawn_numbers == pytest.approx({**colours, "camera_shift front [m]": 0.05, "wind, length": 5})
