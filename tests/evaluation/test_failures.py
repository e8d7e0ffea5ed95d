"""Where episodes fail is told by phase and by condition."""

from dataclasses import replace

import pytest

from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.failures import (
    evaluation_facts,
    phase_meanings,
    phase_table,
)
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import phases

from .made_evals import made_eval


@pytest.mark.parametrize(
    "detail",
    [
        {"start": 3, "goal": "far", "end": None, "drawn": [1]},
        {"start": {"object": [1, 2]}, "goal": [1, 2, float("nan")], "drawn": {"mass": None, "size": "big", "on": True}},
        {"start": {"object": None}, "goal": ["1", 1, 2], "end": {"hand": "xyz"}, "drawn": {"view": {"front": None}}},
    ],
)
def test_detail_of_another_kind_in_a_foreign_file_is_ignored(detail: dict):
    episode = EpisodeResult(1, True, True, 1, 0.0, detail=detail)
    assert (episode.start, episode.goal, episode.end) == (None, None, None)


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
    facts = evaluation_facts(result)
    assert any(fact.startswith("Of 3 conditions knocked has the lowest success: 50.0 %") for fact in facts)
    lost = replace(result, episodes=tuple(replace(e, success_at_end=False) for e in result.episodes))
    assert any("were no longer at the goal" in fact for fact in evaluation_facts(lost))
