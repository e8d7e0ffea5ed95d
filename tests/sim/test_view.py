"""The model that is drawn has the physics model's poses and outlines, and few triangles."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from manip_il.robots.spec import model_bytes
from manip_il.sim import render, view
from manip_il.sim.config import CAMERAS, Look
from manip_il.sim.view import ViewModel
from manip_il.tasks.envs import scene_of

from ..scenes import started
from ..tables import LARGE, every_robot


@every_robot
def test_a_view_has_the_physics_poses_and_at_most_12000_triangles(robot):
    scene = scene_of(robot, "pick_place")
    before = model_bytes(scene.model)
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
    assert model_bytes(scene.model) == before


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
