"""The task `insert`: the hole, where the peg starts, and how the hand turns it."""

import math

import numpy as np
import pytest

from manip_il.seeding import stream_seeds
from manip_il.sim.world import World
from manip_il.tasks.insert import APART
from manip_il.tasks.peg import HOLE, PEG
from manip_il.worlds.ladder.world import make_env, scene_of

from ..scenes import solve, started
from ..tables import every_robot

SEEDS = stream_seeds("certificate", 6)


@pytest.mark.parametrize(("task", "play"), [("insert", 0.002), ("insert_tight", 0.0005)])
def test_the_hole_is_wider_than_the_peg_by_the_play(task: str, play: float):
    world = World(scene_of("panda", task))
    left, right = (world.model.geom(f"hole {side}") for side in ("left", "right"))
    between = left.pos[1] - left.size[0] - (right.pos[1] + right.size[0])
    assert between - world.extents(PEG)[0] == pytest.approx(play)


@every_robot
def test_the_peg_starts_standing_or_lying_apart_from_the_hole(robot: str):
    env, up = make_env(robot, "insert"), set[bool]()
    for seed in SEEDS:
        env.start(seed)
        peg, hole = env.world.pose(PEG), env.world.pose(HOLE)
        up.add(abs(peg.rotation[2, 2]) > 0.5)
        assert math.dist(peg.position[:2], hole.position[:2]) > APART
        corners = peg.position[2] - np.abs(peg.rotation[2]) @ np.array(env.world.extents(PEG)) / 2
        assert corners == pytest.approx(0.0, abs=1e-9)
    assert up == {True, False}


def test_a_peg_that_the_arm_cannot_lean_over_far_enough_is_set_upright_first():
    seen = solve(started("fetch", "insert", SEEDS[0]))
    assert seen.index("set_up") < seen.index("let_stand") < len(seen) - seen[::-1].index("grasp")
