"""The model that is drawn has the physics model's poses and outlines, and few triangles."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from manip_il.sim import render, view
from manip_il.sim.config import CAMERAS, Look
from manip_il.sim.view import ViewModel, cluster
from manip_il.tasks.envs import scene_of

from ..scenes import started
from ..tables import LARGE, every_robot


def ball(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit ball of about 4 rings^2 faces, wound outwards; the vertices of the poles and of the seam are doubled."""
    up, around = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1), indexing="ij")
    vertices = np.stack([np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up)], axis=2).reshape(-1, 3)
    corner = (np.arange(rings)[:, None] * (2 * rings + 1) + np.arange(2 * rings)).ravel()
    right, below = corner + 1, corner + 2 * rings + 1
    return vertices, np.vstack([np.stack([corner, below, right], 1), np.stack([right, below, below + 1], 1)])


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Enclosed by faces that are wound outwards."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def test_merging_keeps_a_balls_volume_and_surface_with_a_fraction_of_its_faces():
    vertices, faces = ball(80)
    merged, originals, few = cluster(vertices, faces)
    assert len(few) < len(faces) / 4
    assert volume(merged, few) == pytest.approx(volume(vertices, faces), rel=0.02)
    assert np.abs(np.linalg.norm(merged, axis=1) - 1).max() < 0.01
    assert np.linalg.norm(vertices[originals] - merged, axis=1).max() < 2 * np.sqrt(12) / 22  # two cells


def test_merging_keeps_a_boxs_edges_sharp():
    steps = np.linspace(-1, 1, 41)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=2).reshape(-1, 2)
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    quads = np.vstack(
        [np.stack([corner, corner + 41, corner + 1], 1), np.stack([corner + 1, corner + 41, corner + 42], 1)]
    )
    vertices, faces = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            square = np.insert(grid, axis, side, axis=1)
            outwards = (side > 0) == (axis != 1)
            faces.append((quads if outwards else quads[:, ::-1]) + len(grid) * len(vertices))
            vertices.append(square)
    joined, same = np.unique(np.vstack(vertices), axis=0, return_inverse=True)
    merged, _, few = cluster(joined, same[np.vstack(faces)])
    assert len(few) < 0.5 * 6 * 3200
    assert volume(merged, few) == pytest.approx(8, rel=0.01)
    assert np.abs(np.abs(merged).max(axis=1) - 1).max() < 0.02  # every vertex on the surface


@every_robot
def test_a_view_has_the_physics_poses_and_at_most_12000_triangles(robot):
    scene = scene_of(robot, "pick_place")
    before = scene.model_bytes()
    drawn = ViewModel(scene, Look()).model
    data, shown = mujoco.MjData(scene.model), mujoco.MjData(drawn)
    data.qpos[scene.arm_q] = shown.qpos[scene.arm_q] = scene.robot.home
    for model, one in ((scene.model, data), (drawn, shown)):
        mujoco.mj_kinematics(model, one)
        mujoco.mj_camlight(model, one)
    for what in ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir"):
        np.testing.assert_array_equal(getattr(shown, what), getattr(data, what))
    seen = (drawn.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (drawn.geom_group < 3)
    assert drawn.mesh_facenum[drawn.geom_dataid[seen]].sum() < 12_000
    assert scene.model_bytes() == before


@pytest.mark.gl
@every_robot
def test_few_faces_look_like_all_of_them(robot, monkeypatch):
    env = started(robot, cameras=CAMERAS)
    few = env.observe().images
    with monkeypatch.context() as patch:
        patch.setattr(view, "_with_few_faces", lambda scene: scene.model)
        render.close()
        every = env.observe().images
    render.close()
    for camera in CAMERAS:
        apart = np.abs(few[camera].astype(int) - every[camera]).max(axis=2)
        near = 1 if robot in LARGE else 3  # as much nearer cameras stand to a small one
        assert apart.mean() < near
        assert (apart > 40).mean() < 0.005 * near**2


def test_a_turn_moves_the_lamps_about_the_vertical_and_brightness_scales_them():
    looks = Look(), Look(brightness=0.5, light_turn=90)
    plain, other = (ViewModel(scene_of("panda", "reach"), look).model for look in looks)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(other.light_pos, plain.light_pos @ quarter.T, atol=1e-12)
    np.testing.assert_allclose(other.light_dir, plain.light_dir @ quarter.T, atol=1e-12)
    np.testing.assert_allclose(other.light_diffuse, plain.light_diffuse / 2)
    np.testing.assert_allclose(other.vis.headlight.ambient, np.divide(plain.vis.headlight.ambient, 2))
    assert plain.vis.quality.shadowsize == other.vis.quality.shadowsize == 0
    assert ViewModel(scene_of("panda", "reach"), Look(shadows=True)).model.vis.quality.shadowsize > 0
