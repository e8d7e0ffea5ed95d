"""Failures are associated with what they depend on, and with nothing else."""

from dataclasses import replace

import pytest

from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.failures import (
    evaluation_facts,
    factor_table,
    find_factors,
    phase_meanings,
    phase_table,
)
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import phases

from .made_evals import made_eval, without_detail


def test_what_failures_depend_on_is_found_and_nothing_else():
    factors = find_factors(made_eval(n=240))
    assert {factor.name for factor in factors if factor.significant} == {
        "start of the object, x [m]",
        "start of the object, y [m]",
    }
    assert factors[0].failed[1] > factors[0].solved[1]
    table = factor_table(factors[:1])
    assert table.rows[0][0] == factors[0].name
    assert table.rows[0][3] == "p < 0.001"


def test_a_failure_in_the_middle_alone_is_seen_too():
    result = made_eval(n=240, fails=lambda _, detail: abs(detail["goal"][1]) < 0.03)
    first = find_factors(result)[0]
    assert (first.name, first.significant) == ("goal, y [m]", True)
    assert first.solved[0] < first.failed[0] < first.failed[2] < first.solved[2]


def test_by_chance_alone_nothing_is_shown():
    factors = find_factors(made_eval(n=240, fails=lambda number, _: number % 5 == 0))
    assert not any(factor.significant for factor in factors)


def test_a_drawn_number_counts_within_its_condition_and_only_if_it_varied():
    names = {factor.name for factor in find_factors(made_eval(n=400))}
    assert {"knocked: knock [m]", "knocked: knock_step [steps]", "sensing: delay [steps]"} <= names
    assert not any("action_noise" in name or "object, z" in name for name in names)


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


def test_vectors_count_by_their_length():
    drawn = {"camera_shift": {"front": [0.0, 0.03, 0.04]}, "wind": [3, 4], "mass": 0.2}
    episode = replace(made_eval(n=1).episodes[0], detail={"drawn": drawn})
    assert episode.drawn_numbers == pytest.approx({"camera_shift front [m]": 0.05, "wind": 5, "mass [kg]": 0.2})


@pytest.mark.parametrize("task", TASKS)
def test_every_phase_of_every_task_has_its_meaning(task: str):
    assert set(phase_meanings(task)) == set(phases(TASKS[task]))
    assert all(phase_meanings(task).values())


def test_phases_come_in_the_order_of_the_task_and_unknown_ones_last():
    table = phase_table([("a", made_eval().episodes), ("b", [])], "pick_place")
    assert [row[0].partition("\n")[0] for row in table.rows] == [
        *("approach", "descend", "open", "grasp", "carry", "at goal", "none")
    ]
    failed = sum(not e.success for e in made_eval().episodes)
    assert (sum(int(row[1]) for row in table.rows), {row[2] for row in table.rows}) == (failed, {"0"})
    episodes = [EpisodeResult(1, False, False, 1, 0.0, "juggle"), EpisodeResult(2, False, False, 1, 0.0)]
    assert phase_table([("a", episodes)], "pick_place").rows[-2:] == (("juggle", "1"), ("not recorded", "1"))
    assert phase_table([("a", episodes[1:])], "pick_place") is None


def test_the_lowest_condition_and_successes_that_did_not_last_are_said():
    result = made_eval(fails=lambda number, detail: detail["condition"] == "knocked" and number % 2 == 0)
    facts = evaluation_facts(result, ())
    assert any(fact.startswith("Of 3 conditions knocked has the lowest success: 50.0 %") for fact in facts)
    lost = replace(result, episodes=tuple(replace(e, success_at_end=False) for e in result.episodes))
    assert any("were no longer at the goal" in fact for fact in evaluation_facts(lost, ()))
