"""Named points of the scene are where pictures show them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from manip_il.evaluation.suites import read_condition
from manip_il.robots import ROBOTS
from manip_il.sim import render
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.sim.points import point_names, points_in
from manip_il.sim.props import Prop
from manip_il.sim.render import pictures, projections
from manip_il.tasks.envs import make_env
from manip_il.tasks.starts import UPRIGHT
from manip_il.tasks.table import TASKS

from ..scenes import SEED, started
from ..tables import every_task

SIZE = CameraConfig(CAMERAS, 96, 128)
RED, BALL = (1.0, 0.0, 1.0, 1.0), int(mujoco.mjtGeom.mjGEOM_SPHERE)


@every_task
def test_every_task_names_its_objects_and_where_they_are_to_go(task: str):
    for seed in range(SEED, SEED + 3):
        world = started("panda", task, seed).world
        found = points_in(world)
        assert tuple(found) == point_names(world.scene)
        for name in TASKS[task].objects:
            np.testing.assert_array_equal(found[name], world.pose(name).position)
        assert len(found) >= 1
        middle = np.array([*world.scene.robot.workspace.centre, 0.1])
        assert all(np.linalg.norm(at - middle) < 0.6 for at in found.values())


def test_corners_of_a_box_are_its_own_and_the_upper_ones():
    world = started("panda", "stack").world
    half = np.asarray(world.extents("top")) / 2
    corners = np.stack([at for name, at in points_in(world).items() if name.startswith("top.corner")])
    inside = (corners - world.pose("top").position) @ world.pose("top").rotation
    np.testing.assert_allclose(np.abs(inside), np.broadcast_to(half, (4, 3)), atol=1e-9)
    assert (corners[:, 2] > world.pose("top").position[2]).all()
    assert len(np.unique(corners.round(6), axis=0)) == 4


@pytest.mark.gl
@pytest.mark.parametrize("robot", list(ROBOTS))
def test_a_spot_that_is_drawn_at_a_point_is_seen_where_the_point_is_said_to_be(robot: str, monkeypatch):
    env = started(robot)
    space = env.scene.robot.workspace
    rng = np.random.default_rng(0)
    points = np.array([*space.centre, 0.2]) + rng.uniform(-0.1, 0.1, (12, 3))

    def with_spots(*spots: np.ndarray) -> dict[str, np.ndarray]:
        balls = [Prop(BALL, np.full(3, 0.012), at, np.eye(3), RED) for at in spots]
        monkeypatch.setattr(render, "props", lambda *_: balls)
        return pictures(env.scene, env.data, SIZE)

    plain = with_spots()
    found, seen = projections(env.scene, SIZE, points), 0
    for number, point in enumerate(points):
        for camera, marked in with_spots(point).items():
            across, down, in_view = found[camera][number].tolist()
            rows, columns = np.nonzero((marked != plain[camera]).any(axis=2))
            whole = 8 < len(rows) < 200 and rows.min() and columns.min() and rows.max() < 95 and columns.max() < 127
            if whole:  # nothing hides it, and the picture's edge does not cut it
                seen += 1
                assert in_view
                assert abs((columns.mean() + 0.5) / 128 - across) < 0.012
                assert abs((rows.mean() + 0.5) / 96 - down) < 0.012
    assert seen > 8


@pytest.mark.gl
@pytest.mark.parametrize("suite", ["nominal", "view"])
def test_the_cube_is_seen_where_its_keypoint_is_whatever_the_camera_does(suite: str):
    conditions = [] if suite == "nominal" else [read_condition(suite)]
    number = point_names(started("panda", "lift").scene).index("object")
    checked = 0
    for seed in range(SEED, SEED + 6):
        env = started("panda", "lift", seed, cameras=CAMERAS, image_size=(96, 96), conditions=conditions)
        seen = env.observe()
        env.world.place("object", np.array([0.5, 0.0, -1.0]), UPRIGHT)
        env.world.update()
        without = env.observe()
        for camera in ("front", "side"):
            across, down, in_view = seen.keypoints[camera][number].tolist()
            rows, columns = np.nonzero((seen.images[camera] != without.images[camera]).any(axis=2))
            if in_view and len(rows) > 25:
                checked += 1
                assert abs((columns.mean() + 0.5) / 96 - across) < 0.03
                assert abs((rows.mean() + 0.5) / 96 - down) < 0.03
    assert checked > 6


@pytest.mark.gl
def test_keypoints_are_as_late_as_their_pictures():
    env = started("panda", cameras=("front",), conditions=[Condition("late", picture_delay=(2, 2))])
    prompt = started("panda", cameras=("front",))
    late = int(env.drawn.number("picture_delay"))
    seen: list[np.ndarray] = []
    got = np.empty(0)
    for _ in range(late + 2):
        seen.append(prompt.observe().keypoints["front"])
        got = env.observe().keypoints["front"]
        for one in (env, prompt):
            one.world.place("goal", one.world.goal + [0.01, 0.0, 0.0], UPRIGHT)
            one.world.update()
    np.testing.assert_array_equal(got, seen[-1 - late])
    assert not np.array_equal(got, seen[-1])


def test_without_cameras_there_are_none():
    assert make_env("panda").observe().keypoints == {}
