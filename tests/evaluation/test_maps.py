"""The map marks every episode at its places, the failed ones by shape and line, and both sides' in one scale."""

import re
from dataclasses import replace

import numpy as np
import pytest

from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.eval_report import eval_report
from manip_il.evaluation.failures import phase_rows
from manip_il.evaluation.maps import MAP_HEIGHT, MAX_MARKS, WIDTH, failure_map, fit_view, paired_maps
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import phases

from .made_evals import far_corner, made_comparison, made_eval, without_detail


def test_every_episode_is_marked_in_both_views():
    result = made_eval()
    failed = len(result.episodes) - result.success.successes
    assert failed > 10
    html = eval_report(result, "c").render()
    assert len(re.findall('class="mark-failed"><title>', html)) == 2 * failed
    assert len(re.findall('class="mark-solved"><title>', html)) == 2 * result.success.successes


def test_a_failed_episode_has_a_line_and_its_end_and_a_solved_one_has_not():
    result = made_eval(n=4, fails=lambda number, _: number == 0, conditions=("nominal",))
    html = eval_report(result, "c").render()
    marks = re.findall(r'<g class="mark-(\w+)"><title>.*?</title>(.*?)</g>', html, re.DOTALL)
    for outcome, drawn in marks:
        assert (drawn.count("<line "), drawn.count('class="ended"')) == ((1, 1) if outcome == "failed" else (0, 0))
    assert f"seed {result.episodes[0].seed}, nominal, failed, ended in descend: start (" in html


def test_all_marks_lie_within_the_picture():
    for _, marks in failure_map(made_eval()).views:
        for x, y in [place for mark in marks for place in (mark.start, mark.goal)]:
            assert 0 < x < WIDTH
            assert 0 < y < MAP_HEIGHT


@pytest.mark.parametrize("axes", [(0, 1), (0, 2)])
def test_a_place_is_drawn_in_scale(axes: tuple[int, int]):
    points = np.array([[0.3, -0.1, 0.0], [0.6, 0.1, 0.4]])
    (x0, y0), (x1, y1) = fit_view(points, *axes, MAP_HEIGHT).project(points)
    assert (x1 - x0) / (y0 - y1) == pytest.approx((0.6 - 0.3) / (points[1] - points[0])[axes[1]])


def test_an_object_that_rolled_far_away_does_not_shrink_the_map():
    result = made_eval(n=6, fails=lambda number, _: number == 0)
    result.episodes[0].detail["end"]["object"][0] = 50.0  # pyright: ignore[reportIndexIssue]
    near = made_eval(n=6, fails=lambda number, _: number == 0)
    for (_, far_marks), (_, near_marks) in zip(failure_map(result).views, failure_map(near).views, strict=True):
        assert [mark.start for mark in far_marks] == [mark.start for mark in near_marks]
        assert ([mark.end for mark in far_marks].count(None), [mark.end for mark in near_marks].count(None)) == (6, 5)


def test_a_crowd_is_thinned_evenly_and_the_note_says_so():
    crowd = failure_map(made_eval(n=MAX_MARKS + 250, fails=lambda number, _: number % 50 == 0))
    for _, marks in crowd.views:
        outcomes = [drawn.mark.outcome for drawn in marks]
        assert (outcomes.count("failed"), outcomes.count("solved")) == (17, MAX_MARKS)
    assert crowd.thinning_note.startswith(f"{850 - 17 - MAX_MARKS} of 850 episodes are left out")
    assert replace(crowd, marks=crowd.marks[:100]).thinning_note == ""


def test_an_episode_without_places_is_left_out():
    assert failure_map(without_detail(made_eval())) is None


def test_a_comparison_marks_what_one_side_alone_failed_in():
    comparison = made_comparison(left=lambda number, _: number < 30, right=lambda number, _: 20 <= number < 35)
    left, right = (one.marks for one in paired_maps(comparison))
    kinds = [[mark.outcome for mark in marks] for marks in (left, right)]
    assert [kinds[0].count(kind) for kind in ("failed", "shared", "solved")] == [20, 10, 90]
    assert [kinds[1].count(kind) for kind in ("failed", "shared", "solved")] == [5, 10, 105]
    assert [mark.start for mark in left] == [mark.start for mark in right]


def test_over_training_seeds_the_side_that_fails_more_often_is_marked():
    comparison = made_comparison(far_corner, lambda *_: False, seeds=3)
    left, right = (one.marks for one in paired_maps(comparison))
    assert {mark.outcome for mark in left} == {"failed", "solved"}
    assert {mark.outcome for mark in right} == {"solved"}
    assert any(mark.words.endswith("failed in 3 of 3 training seeds") for mark in left)


def test_the_legend_names_only_what_is_there():
    assert "failed: from start to goal" not in eval_report(made_eval(fails=lambda *_: False), "c").render()
    html = eval_report(made_eval(), "c").render()
    assert "failed: from start to goal" in html
    assert "where the object ended" in html


@pytest.mark.parametrize("task", TASKS)
def test_every_phase_of_every_task_has_its_meaning(task: str):
    rows = phase_rows([made_eval().episodes], task)
    assert {row.name for row in rows if row.meaning} == set(phases(TASKS[task]))


def test_phases_come_in_the_order_of_the_task_and_unknown_ones_last():
    rows = phase_rows([made_eval().episodes], "pick_place")
    assert [row.name for row in rows] == ["approach", "descend", "open", "grasp", "carry", "at_goal", "none"]
    assert sum(row.counts[0] for row in rows) == sum(not e.success for e in made_eval().episodes)
    episodes = [EpisodeResult(1, False, False, 1, 0.0, "juggle"), EpisodeResult(2, False, False, 1, 0.0)]
    last_two = [(row.name, row.counts) for row in phase_rows([episodes], "pick_place")[-2:]]
    assert last_two == [("juggle", (1,)), ("not recorded", (1,))]
