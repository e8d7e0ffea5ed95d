"""What `robot check` measures of hand, reach and starts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from manip_il.evaluation import robot_check
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.robot_check import (
    RobotCheck,
    TaskCheck,
    advice,
    check_report,
    check_starts,
    task_table,
    verdict,
)
from manip_il.evaluation.tables import CLONING, EXPERT
from manip_il.robots.gripper import sweep
from manip_il.robots.reach import Reach
from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot
from manip_il.sim.posture import meeting_at
from manip_il.sim.scene import PREFIX
from manip_il.tasks.envs import scene_of

from ..tables import every_robot
from .own import model_of, write

EVERYWHERE = Reach(np.array([-1.0, -1.0, 0.0]), np.zeros((41, 41, 21)))


@every_robot
def test_a_hand_opens_with_its_command(robot: str):
    openings = sweep(get_robot(robot)).openings
    assert (np.diff(openings) > 0).all()
    assert openings.max() == scene_of(robot, "reach").gripper.most


@every_robot
def test_at_home_nothing_overlaps(robot: str):
    scene = scene_of(robot, "reach")
    assert meeting_at(scene.robot, scene.model, PREFIX, np.asarray(scene.robot.home)) == {}


def test_parts_that_overlap_are_named_and_how_deep(tmp_path: Path):
    scene = scene_of(str(write(tmp_path)), "reach")
    found = meeting_at(scene.robot, scene.model, PREFIX, np.array([0, 1.6, 1.0, 1.0, 0]))
    assert ("fore", "table") in found
    assert 0.01 < found["fore", "table"] < 0.1


def test_neighbours_that_overlap_in_any_posture_are_no_fault_of_home(tmp_path: Path):
    long = model_of().replace('size="0.03" fromto="0 0 0.05', 'size="0.03" fromto="0 0 -0.15')  # into the base
    scene = scene_of(str(write(tmp_path, model=long)), "reach")
    found = meeting_at(scene.robot, scene.model, PREFIX, np.asarray(scene.robot.home))
    assert set(found) == {("base", "upper")}


def test_starts_are_drawn_until_one_finds_no_place(own: Robot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    path = str(write(tmp_path))
    monkeypatch.setattr("manip_il.sim.world.reach_of", lambda robot: EVERYWHERE)
    facts = check_starts(path, "reach")
    assert (facts.starts, facts.refused, facts.done) == (50, "", True)
    monkeypatch.setattr("manip_il.sim.world.reach_of", lambda robot: Reach(EVERYWHERE.origin, EVERYWHERE.errors + 1))
    facts = check_starts(path, "reach")
    assert (facts.starts, facts.done) == (0, False)
    assert "none of 1000 places" in facts.refused


def a_check(own: Robot, *tasks: TaskCheck, table: float = 1.0) -> RobotCheck:
    return RobotCheck("own.yaml", own, 0.09, (), table, tasks)


def evaluation(solved: int) -> EvalResult:
    episodes = tuple(EpisodeResult(i, i < solved, i < solved, 9, 0.0, "close" if i < 9 else "reach") for i in range(10))
    return EvalResult("expert", "own", "lift", {}, episodes, EvalSettings(100, 0.02))


SOLVED, FAILED = evaluation(10), evaluation(7)
TASK_CHECKS = {
    "solved": (TaskCheck("lift", 50, clean=SOLVED, noisy=FAILED), True, []),
    "not asked": (TaskCheck("lift", 50), True, []),
    "failed": (
        TaskCheck("lift", 50, clean=FAILED, noisy=FAILED),
        False,
        ["lift: the expert fails in 3 of 10", "2 in phase close", "--robot.type=own.yaml --task.type=lift"],
    ),
    "too wide": (
        TaskCheck("lift", 0, "it is 0.12 m wide"),
        False,
        ["lift: it is 0.12 m wide"],
    ),
    "no room": (TaskCheck("sort", 3, "no place for it"), False, ["sort: no place for it"]),
}


@pytest.mark.parametrize("case", TASK_CHECKS)
def test_what_cannot_be_done_is_said_with_what_to_change(case: str, own: Robot, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robot_check, "reach_of", lambda robot: EVERYWHERE)
    task, done, words = TASK_CHECKS[case]
    check = a_check(own, task)
    assert task.done == done
    assert ("cannot" in verdict(check)) == (not done)
    assert len(advice(check)) == (not done)
    assert all(word in " ".join(advice(check)) for word in words)
    assert task_table(check).colours == (EXPERT if done else CLONING,)
    page = check_report(check, (), "no OpenGL here", "manip-il robot check", {}).render()
    assert task.name in page
    assert "No pictures: no OpenGL here" in page
    assert json.loads(json.dumps(check.to_json()))["tasks"][0]["done"] == done


def test_a_task_that_random_actions_spoil_is_said_beside_what_can_be_done(own: Robot):
    spoiled, steady = (
        TaskCheck(name, 50, clean=SOLVED, noisy=noisy) for name, noisy in (("lift", FAILED), ("reach", SOLVED))
    )
    said = "with a tenth of the steps random the expert solves lift in 7 of 10 episodes"
    assert said in verdict(a_check(own, spoiled, steady))
    assert verdict(a_check(own, steady)) == "own can do 1 of 1 task."


def test_a_workspace_beyond_reach_is_to_be_smaller_or_elsewhere(own: Robot):
    said = " ".join(advice(a_check(own, table=0.7)))
    assert "a smaller half_width than 0.12, or move workspace.centre, (0.4, 0)" in said
    assert advice(a_check(own)) == ()
