"""The map marks every episode where it was, the failed ones by shape and line, and both sides' in one scale."""

import re

import numpy as np
import pytest

from manip_il.evaluation.failure_map import MAX_MARKS, failure_map, map_legend, map_marks, thinning_note
from manip_il.evaluation.paired_map import paired_marks
from manip_il.evaluation.path_charts import WIDTH, fit_view
from manip_il.evaluation.phase_chart import phase_chart, phase_rows
from manip_il.evaluation.results import EpisodeResult
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import phases

from .made_evals import far_corner, made_comparison, made_eval, without_detail
from .test_report import Page


def count(html: str, kind: str) -> int:
    return len(re.findall(rf'class="mark-{kind}"', html))


def test_every_episode_is_marked_in_both_views():
    result = made_eval()
    html = failure_map(map_marks(result), result.policy)
    failed = len(result.episodes) - result.success.successes
    assert failed > 10
    assert (count(html, "failed"), count(html, "solved")) == (2 * failed, 2 * result.success.successes)
    assert Page(html).open == []


def test_a_failed_episode_has_a_line_and_where_it_ended_and_a_solved_one_has_not():
    result = made_eval(n=4, fails=lambda number, _: number == 0, conditions=("nominal",))
    html = failure_map(map_marks(result))
    assert html.count('class="ended"') == 2
    assert html.count("<line ") - html.count('class="scale"') == 2
    assert f"seed {result.episodes[0].seed}, nominal, failed, ended in descend: start (" in html


def test_all_marks_lie_within_the_picture():
    result = made_eval()
    for x, y in re.findall(r'cx="([-\d.]+)" cy="([-\d.]+)"', failure_map(map_marks(result))):
        assert 0 < float(x) < WIDTH
        assert 0 < float(y) < 300


def test_a_place_is_drawn_in_scale():
    points = np.array([[0.3, -0.1, 0.0], [0.6, 0.1, 0.4]])
    for axes in ((0, 1), (0, 2)):
        view = fit_view(points, *axes, 300.0)
        (x0, y0), (x1, y1) = view.project(points)
        assert (x1 - x0) / (y0 - y1) == pytest.approx((0.6 - 0.3) / (points[1] - points[0])[axes[1]])


def test_an_object_that_rolled_far_away_does_not_shrink_the_map():
    result = made_eval(n=6, fails=lambda number, _: number == 0)
    result.episodes[0].detail["end"]["object"][0] = 50.0  # pyright: ignore[reportIndexIssue]
    near = made_eval(n=6, fails=lambda number, _: number == 0)
    htmls = [failure_map(map_marks(one)) for one in (result, near)]
    assert re.findall(r"<circle[^>]*>", htmls[0]) == re.findall(r"<circle[^>]*>", htmls[1])
    assert [html.count('class="ended"') for html in htmls] == [0, 2]


def test_a_crowd_is_thinned_evenly_and_the_note_says_so():
    result = made_eval(n=MAX_MARKS + 250, fails=lambda number, _: number % 50 == 0)
    marks = map_marks(result)
    html = failure_map(marks)
    assert count(html, "failed") == 2 * 17
    assert count(html, "solved") == 2 * MAX_MARKS
    assert thinning_note(marks).startswith(f"{850 - 17 - MAX_MARKS} of 850 episodes are left out")
    assert thinning_note(marks[:100]) == ""


def test_an_episode_that_does_not_tell_its_places_is_left_out():
    assert map_marks(without_detail(made_eval())) == ()


def test_a_comparison_marks_what_one_side_alone_failed_in():
    comparison = made_comparison(left=lambda number, _: number < 30, right=lambda number, _: 20 <= number < 35)
    left, right = paired_marks(comparison)
    kinds = [[mark.outcome for mark in marks] for marks in (left, right)]
    assert [kinds[0].count(kind) for kind in ("failed", "shared", "solved")] == [20, 10, 90]
    assert [kinds[1].count(kind) for kind in ("failed", "shared", "solved")] == [5, 10, 105]
    assert [mark.start for mark in left] == [mark.start for mark in right]


def test_over_training_seeds_the_side_that_fails_more_often_is_marked():
    comparison = made_comparison(far_corner, lambda *_: False, seeds=3)
    left, right = paired_marks(comparison)
    assert {mark.outcome for mark in left} == {"failed", "solved"}
    assert {mark.outcome for mark in right} == {"solved"}
    assert any(mark.words.endswith("failed in 3 of 3 training seeds") for mark in left)


def test_the_legend_names_only_what_is_there():
    words = {"solved": "solved", "failed": "failed"}
    assert "failed" not in map_legend(map_marks(made_eval(fails=lambda *_: False)), words, "object")
    legend = map_legend(map_marks(made_eval()), words, "object")
    assert "where the object ended" in legend


def test_phases_come_in_the_order_of_the_task_with_what_they_mean():
    rows = phase_rows([made_eval().episodes], "pick_place")
    assert [row.name for row in rows] == ["approach", "descend", "open", "grasp", "carry", "at_goal", "none"]
    assert all(row.meaning for row in rows)
    failed = [e for e in made_eval().episodes if not e.success]
    assert sum(row.counts[0] for row in rows) == len(failed)


@pytest.mark.parametrize("task", TASKS)
def test_every_phase_of_every_task_is_told(task: str):
    rows = phase_rows([made_eval().episodes], task)
    assert {row.name for row in rows if row.meaning} == set(phases(TASKS[task]))


def test_a_phase_that_the_ladder_does_not_know_is_counted_all_the_same():
    episodes = [EpisodeResult(1, False, False, 1, 0.0, "juggle"), EpisodeResult(2, False, False, 1, 0.0)]
    rows = {row.name: row.counts for row in phase_rows([episodes], "pick_place")}
    assert rows["juggle"] == rows["not recorded"] == (1,)
    page = Page(phase_chart(phase_rows([episodes], "pick_place"), ["cloning"], ["p"]))
    assert page.open == []
    assert "juggle" in page.text
