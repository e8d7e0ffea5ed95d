"""Cameras and table of the scene stand where a robot's YAML says."""

from typing import Any

import numpy as np
import pytest

from manip_il.sim.config import CameraConfig
from manip_il.sim.render import pictures, projections
from manip_il.sim.scene import camera_id
from manip_il.worlds.ladder.world import make_env, scene_of

from .own import tree_of, write

PLACED = {
    "obliquely": {"position": [0.9, -0.4, 0.6], "target": [0.3, 0.0, 0.1], "fovy": 50},
    "straight down": {"position": [0.3, 0.0, 0.9], "target": [0.3, 0.0, 0.0]},
}


def placed(cameras: dict[str, Any]) -> dict[str, Any]:
    return tree_of("slides") | {"cameras": cameras}


@pytest.mark.gl
@pytest.mark.parametrize("pose", PLACED.values(), ids=PLACED)
def test_the_target_is_in_the_middle_of_the_picture(pose, tmp_path):
    env = make_env(str(write(tmp_path, tree=placed({"front": pose}))), "reach", cameras=("front",))
    env.start(0)
    config = CameraConfig(("front",), 64, 96)
    pictures(env.scene, env.data, config)
    target = np.array(pose["target"])
    points = np.array([target, target + [0.1, 0.0, 0.0], target + [0.0, 0.1, 0.0]])
    middle, ahead, left = projections(env.scene, config, points)["front"]
    np.testing.assert_allclose(middle, [0.5, 0.5, 1.0], atol=1e-5)
    if pose["position"][:2] == pose["target"][:2]:
        assert ahead[1] < 0.5 - 0.05  # away from the robot is up
        assert left[0] < 0.5 - 0.05


def test_what_is_not_said_stays_and_another_cameras_place_is_that_of_every_robot(tmp_path):
    own = scene_of(write(tmp_path, tree=placed({"front": PLACED["obliquely"]})), "reach").model
    plain = scene_of(write(tmp_path, "plain"), "reach").model
    front, side = (camera_id(own, name) for name in ("front", "side"))
    np.testing.assert_allclose(own.cam_pos[front], PLACED["obliquely"]["position"])
    assert own.cam_fovy[front] == 50
    np.testing.assert_array_equal(own.cam_pos[side], plain.cam_pos[side])


def test_the_table_is_as_large_and_as_high_as_said(tmp_path):
    tree = tree_of("slides") | {"table": {"size": [0.8, 0.7], "height": 0.75}}
    model = scene_of(write(tmp_path, tree=tree), "reach").model
    np.testing.assert_allclose(2 * model.geom("table").size[:2], [0.8, 0.7])
    assert model.geom("table").pos[2] + model.geom("table").size[2] == 0.0
    assert model.geom("floor").pos[2] == -0.75
    leg = model.geom("leg0")
    assert leg.pos[2] - leg.size[2] == pytest.approx(-0.75)
