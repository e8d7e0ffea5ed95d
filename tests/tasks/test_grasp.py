"""How shapes lie, and where a hand that points down grasps them."""

import math
from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.collect.job import RolloutJob
from manip_il.robots.geometry import hand_down
from manip_il.seeding import stream_seeds
from manip_il.sim.env import environment_state_names
from manip_il.sim.world import World
from manip_il.tasks.grasp import Lie, lie_of
from manip_il.tasks.objects import UPWARDS, observe_object, product, turn_left
from manip_il.tasks.pick_place import OBJECT
from manip_il.worlds.ladder.world import make_env
from manip_il.worlds.table import make_config

from ..scenes import SEED, started

SHAPES = (
    "box:0.05",
    "box:0.06x0.04x0.03",
    "box:0.03x0.03x0.06",
    "cylinder:0.04x0.06",
    "sphere:0.04",
    "capsule:0.03x0.06",
)
shapes = st.sampled_from(SHAPES)
yaws = st.floats(-math.pi, math.pi)


@cache
def world_of(shape: str) -> World:
    return make_env(object=shape).world


def turned(world: World, yaw: float, up: int) -> Lie:
    """The object on the table, its own axis `up` upwards, turned about the vertical."""
    at = np.array([0.5, 0.0, world.extents(OBJECT)[up] / 2])
    world.place(OBJECT, at, product(turn_left(yaw), UPWARDS[up]))
    world.update()
    return lie_of(world, OBJECT)


def span(world: World, direction: np.ndarray) -> float:
    """How long the object is along a direction (3,) [m]."""
    axes, lengths = world.pose(OBJECT).rotation.T @ direction, np.array(world.extents(OBJECT))
    kind = mujoco.mjtGeom(world.kind(OBJECT))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return float(np.abs(axes) @ lengths)
    across = float(np.hypot(axes[0], axes[1])) if kind != mujoco.mjtGeom.mjGEOM_CAPSULE else 1.0
    length = lengths[2] - (lengths[0] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0)
    return (
        float(across * lengths[0] + abs(axes[2]) * length)
        if kind != mujoco.mjtGeom.mjGEOM_SPHERE
        else lengths[0]
    )


@given(shapes, yaws, st.integers(0, 2))
def test_a_grasps_width_is_the_objects_between_the_fingers(shape: str, yaw: float, up: int):
    world = world_of(shape)
    lie = turned(world, yaw, up)
    assert lie.tilt == pytest.approx(0, abs=1e-6)
    assert lie.tall == pytest.approx(span(world, np.array([0.0, 0.0, 1.0])))
    for turn, width, length, _ in lie.grasps:
        hand = hand_down(turn)
        assert width == pytest.approx(span(world, hand[:, 1]), abs=1e-6)
        assert length == pytest.approx(span(world, hand[:, 0]), abs=1e-6)


@given(shapes, yaws, st.integers(0, 2))
def test_what_looks_alike_is_observed_alike(shape: str, yaw: float, up: int):
    world = world_of(shape)
    folds = turned(world, yaw, up).folds
    seen = observe_object(world, OBJECT)
    turned(world, yaw + (2 * math.pi / folds if folds else 1.0), up)
    again = observe_object(world, OBJECT)
    for name in seen:
        np.testing.assert_allclose(again[name], seen[name], atol=1e-6, err_msg=name)


def test_a_cube_is_observed_as_ever_and_other_shapes_with_their_lengths():
    cube = [
        name
        for name in environment_state_names(make_env(object="box:0.03").scene)
        if name.startswith(OBJECT)
    ]
    assert cube == [
        name for name in environment_state_names(make_env().scene) if name.startswith(OBJECT)
    ]
    assert {"object.folds", "object.width", "object.length", "object.height"} < set(
        environment_state_names(world_of("capsule:0.03x0.06").scene)
    )


@pytest.mark.parametrize(
    ("shape", "heights"),
    [
        ("box:0.06x0.04x0.03", {0.06, 0.04, 0.03}),
        ("cylinder:0.04x0.06", {0.04, 0.06}),
        ("sphere:0.04", {0.04}),
        ("capsule:0.03x0.06", {0.03}),
    ],
)
def test_starts_lie_and_stand_where_the_shape_has_it(shape: str, heights: set[float]):
    found = set()
    for seed in range(SEED, SEED + 40):
        env = started(seed=seed, object=shape)
        lie, at = lie_of(env.world, OBJECT), env.world.pose(OBJECT).position
        assert lie.tilt == pytest.approx(0, abs=1e-6)
        assert at[2] == pytest.approx(lie.tall / 2)
        found.add(round(lie.tall, 6))
    assert found == heights


@pytest.mark.parametrize(
    "shape",
    ["box:0.06x0.04x0.02", "cylinder:0.02", "cylinder:0.06", "sphere:0.02", "capsule:0.06", "any"],
)
@pytest.mark.parametrize("task", ["pick_place", "lift"])
def test_the_expert_brings_any_shape_to_its_goal(task: str, shape: str):
    job = RolloutJob(make_config(task=task, object=shape), hold=0)
    assert all(episode.success for episode in job.run(stream_seeds("certificate", 3)))
