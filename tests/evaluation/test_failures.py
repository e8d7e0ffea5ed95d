"""Where episodes fail is told by phase and by condition."""

from dataclasses import replace

import pytest

from manip_il.evaluation.eval_report import evaluation_facts, phase_meanings, phase_table
from manip_il.evaluation.results import EpisodeResult
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import phases

from .made_evals import made_eval


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
