"""What `robot check` measures of hand, reach and starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from manip_il.evaluation.robot_check import (
    check_starts,
)
from manip_il.robots.geometry import meeting_at
from manip_il.robots.reach import Reach
from manip_il.robots.robot import Robot
from manip_il.sim.scene import PREFIX
from manip_il.tasks.envs import scene_of

from ..tables import every_robot
from .own import write

EVERYWHERE = Reach(np.array([-1.0, -1.0, 0.0]), np.zeros((41, 41, 21)))


@every_robot
def test_at_home_nothing_overlaps(robot: str):
    scene = scene_of(robot, "reach")
    assert meeting_at(scene.robot, scene.model, PREFIX, np.asarray(scene.robot.home)) == {}


def test_parts_that_overlap_are_named_and_how_deep(tmp_path: Path):
    scene = scene_of(str(write(tmp_path)), "reach")
    found = meeting_at(scene.robot, scene.model, PREFIX, np.array([0, 1.6, 1.0, 1.0, 0]))
    assert ("fore", "table") in found
    assert 0.01 < found["fore", "table"] < 0.1


def test_starts_are_drawn_until_one_finds_no_place(own: Robot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    path = str(write(tmp_path))
    monkeypatch.setattr("manip_il.sim.world.reach_of", lambda robot: EVERYWHERE)
    facts = check_starts(path, "reach")
    assert (facts.starts, facts.refused, facts.done) == (50, "", True)
    monkeypatch.setattr("manip_il.sim.world.reach_of", lambda robot: Reach(EVERYWHERE.origin, EVERYWHERE.errors + 1))
    facts = check_starts(path, "reach")
    assert (facts.starts, facts.done) == (0, False)
    assert "none of 1000 places" in facts.refused
