"""The model that is drawn has the physics model's poses and outlines, and few triangles."""

import numpy as np
import pytest

from manip_il.sim import render, view
from manip_il.sim.config import CAMERAS

from ..scenes import started
from ..tables import LARGE, every_robot


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
