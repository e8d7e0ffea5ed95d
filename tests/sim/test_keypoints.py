"""Named points of the scene are where pictures show them."""

import mujoco
import numpy as np
import pytest

from manip_il.robots import ROBOTS
from manip_il.sim import render
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.sim.render import Prop, pictures, point_names, points_in, projections
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


@pytest.mark.gl
@pytest.mark.parametrize("robot", list(ROBOTS))
def test_a_spot_that_is_drawn_at_a_point_is_seen_where_the_point_is_said_to_be(
    robot: str, monkeypatch
):
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
            whole = (
                8 < len(rows) < 200
                and rows.min()
                and columns.min()
                and rows.max() < 95
                and columns.max() < 127
            )
            if whole:  # nothing hides it, and the picture's edge does not cut it
                seen += 1
                assert in_view
                assert abs((columns.mean() + 0.5) / 128 - across) < 0.012
                assert abs((rows.mean() + 0.5) / 96 - down) < 0.012
    assert seen > 8
