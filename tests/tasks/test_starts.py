"""Where objects and goals start."""

from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manip_il.seeding import rng_for
from manip_il.sim.scene import SCENES_KEPT
from manip_il.sim.task import Start
from manip_il.sim.variation import with_drawn
from manip_il.sim.world import GOAL, World
from manip_il.tasks.objects import FROM_HAND, FROM_HAND_SHARE
from manip_il.tasks.table import TASKS, get_task
from manip_il.worlds.ladder.world import make_env, scene_of

from ..scenes import SEED, half_height, has_goal
from ..tables import every_scene, every_scene_that_grasps

seeds = st.integers(0, 2**40)
edges = st.sampled_from([None, 0.03, 0.07])  # of a cube, None for the model's own [m]


@lru_cache(SCENES_KEPT)
def _world(robot: str, task: str) -> World:
    return World(scene_of(robot, task))


def world_of(robot: str, task: str, edge: float | None = None) -> World:
    world = _world(robot, task)
    world.vary(with_drawn(world.scene.nominal, {} if edge is None else {"size": edge}))
    return world


def start(world: World, seed: int) -> Start:
    return world.scene.task.draw(rng_for(seed, "reset"), world)


def position(drawn: Start, name: str) -> np.ndarray:
    return drawn.poses[name][0]


@every_scene
@given(edge=edges, seed=seeds)
@settings(max_examples=20)
def test_everything_that_is_drawn_is_within_reach(
    robot: str, task: str, edge: float | None, seed: int
):
    world = world_of(robot, task, edge)
    poses = start(world, seed).poses
    assert (GOAL in poses) == has_goal(world)
    assert set(TASKS[task].objects) <= set(poses)
    for name, (at, quaternion) in poses.items():
        if name == GOAL or name in world.scene.objects:
            assert world.reach.has(at), f"{name} at {at}"
        assert np.linalg.norm(quaternion) == pytest.approx(1)


@every_scene_that_grasps
@given(edge=edges, seed=seeds)
@settings(max_examples=20)
def test_an_object_rests_on_the_table_and_not_under_the_hand(
    robot: str, task: str, edge: float | None, seed: int
):
    world = world_of(robot, task, edge)
    space, drawn = world.scene.robot.workspace, start(world, seed)
    for name in get_task(task).objects:
        at, quaternion = drawn.poses[name]
        from_centre = at[:2] - space.centre
        world.place(name, at, quaternion)
        world.update()
        assert at[2] == pytest.approx(half_height(world, name), abs=1e-12)
        if task != "sort":  # whose bins stand there
            assert np.abs(from_centre).max() <= space.half_width
        assert np.hypot(*from_centre) >= min(FROM_HAND, FROM_HAND_SHARE * space.half_width)


@every_scene
def test_a_start_has_no_contact_but_of_what_rests(robot: str, task: str):
    env = make_env(robot, task)
    objects, table = (
        {one.geom for one in env.scene.objects.values()},
        env.scene.model.geom("table").id,
    )
    for seed in range(SEED, SEED + 20):
        env.start(seed)
        for contact in env.data.contact:
            assert contact.dist > -1e-4
            geoms = set(contact.geom)
            on_table = table in geoms and objects & geoms
            within_robot = not objects & geoms and env.scene.model.geom_bodyid[contact.geom].all()
            assert on_table or within_robot  # fingers may start closed


@every_scene
def test_a_start_is_the_home_posture_within_its_jitter_and_any_opening(robot: str, task: str):
    env = make_env(robot, task)
    openings, gripper = [], env.scene.gripper
    for seed in range(SEED, SEED + 40):
        env.start(seed)
        assert np.abs(env.data.qpos[env.scene.arm_q] - env.scene.robot.home).max() <= 0.03
        assert env.data.qvel.max() == env.data.qvel.min() == 0
        openings.append(env.world.opening)
    share = (np.array(openings) - gripper.least) / (gripper.most - gripper.least)
    assert -1e-9 <= share.min() < 0.2
    assert 0.8 < share.max() <= 1 + 1e-9
