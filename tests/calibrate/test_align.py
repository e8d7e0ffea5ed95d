"""Cameras and zeros are found from pictures of a board, and what spoils them is told."""

from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manip_il.calibrate import board
from manip_il.cli.main import main
from manip_il.robots.table import get_robot
from manip_il.sim.scene import camera_id
from manip_il.sim.world import World
from manip_il.worlds.ladder.world import scene_of

from ..boards import CAMERAS, SIZE, ZEROS, write


def aligned(dataset: Path, output: Path, *words: str) -> int:
    return main(["robot", "align", str(dataset), f"--output_dir={output}", *words])


def test_the_cameras_and_zeros_of_a_hidden_arm_are_found(tmp_path, capsys):
    assert aligned(write(tmp_path / "seen"), tmp_path / "found") == 0
    assert "shoulder_pan" in capsys.readouterr().out
    assert (tmp_path / "found/report.html").is_file()
    robot = get_robot(tmp_path / "found/arm.yaml")
    assert [*robot.zeros] == ["shoulder_lift", "elbow_flex", "wrist_flex"]  # what can be told
    assert [*robot.zeros.values()] == pytest.approx(np.degrees(ZEROS[1:-1]), abs=0.3)
    # the simulated cameras are those that took the pictures
    scene = scene_of(tmp_path / "found/arm.yaml", "reach")
    front = camera_id(scene.model, "front")
    np.testing.assert_allclose(scene.model.cam_pos[front], CAMERAS["front"][3:6], atol=0.006)
    focal = SIZE[1] / 2 / np.tan(np.radians(scene.model.cam_fovy[front]) / 2)
    assert focal == pytest.approx(380, rel=0.02)
    world, wrist = World(scene), camera_id(scene.model, "wrist")
    mujoco.mj_forward(scene.model, world.data)
    axes = world.ee.rotation.T @ world.data.cam_xmat[wrist].reshape(3, 3) * [1, -1, -1]
    turn = Rotation.from_matrix(axes) * Rotation.from_rotvec(CAMERAS["wrist"][:3]).inv()
    assert turn.magnitude() < np.radians(0.5)
    place = world.ee.rotation.T @ (world.data.cam_xpos[wrist] - world.ee.position)
    np.testing.assert_allclose(place, CAMERAS["wrist"][3:6], atol=0.002)


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        ({"shown": False}, "no board"),
        ({"rests": 3}, "9 pictures"),
        ({"scale": 0.9}, "--ruler"),
    ],
    ids=["no board", "too few rests", "wrong size"],
)
def test_what_spoils_a_dataset_is_one_line(spoilt, words, tmp_path, capsys):
    assert aligned(write(tmp_path / "seen", **spoilt), tmp_path / "found", "--quiet") == 1
    [line] = capsys.readouterr().err.strip().splitlines()
    assert words in line


def test_a_printed_board_is_recognised_and_another_is_not(tmp_path):
    assert main(["robot", "board", f"--output={tmp_path / 'board.pdf'}"]) == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    grey = np.pad(board.drawn(), 50, constant_values=200)
    places, pixels, _ = board.corners_in(np.repeat(grey[:, :, None], 3, axis=2), board.SQUARE)
    dots = places[:, :2] * [1, -1] / board.SQUARE * 100 + 50
    assert len(pixels) == 35
    np.testing.assert_allclose(pixels, dots, atol=0.2)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    other = cv2.aruco.CharucoBoard((5, 7), 0.04, 0.03, dictionary).generateImage([500, 700])
    corners, _, markers = board.corners_in(np.repeat(other[:, :, None], 3, axis=2), board.SQUARE)
    assert markers > 0
    assert len(corners) == 0
