"""Datasets of an arm that looks at the board of `robot align`, drawn without a simulator."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from manip_il.calibrate import board
from manip_il.calibrate.align import HandPoses, project
from manip_il.data.dataset import EpisodeData
from manip_il.data.lerobot_write import write_episodes
from manip_il.mdp import F64
from manip_il.robots.table import get_robot

ROBOT = get_robot("so101")
SIZE, FPS = (320, 240), 10
RESTS, PLACES, STILL = 8, 3, 4  # rests in each place of the board, and frames of a rest
ZEROS = np.radians([0.0, 1.5, -1.0, 1.2, 0.0])  # hidden
PLAIN = np.array([*ROBOT.home]) + [0.0, -0.3, -0.2, 0.1, 0.0]


def looking(position: Sequence[float], target: Sequence[float], focal: float) -> F64:
    """Return a camera's parameters, (9,)."""
    ahead = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(ahead, [0, 0, 1.0]) / np.linalg.norm(np.cross(ahead, [0, 0, 1.0]))
    rotation = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    turn = Rotation.from_matrix(rotation).as_rotvec()
    return np.array([*turn, *position, np.log(focal), 0.0, 0.0])


CAMERAS = {
    "front": looking([0.55, -0.1, 0.4], [0.22, 0.0, 0.0], 380.0),
    "wrist": looking([0.06, 0.01, -0.06], [0.01, 0.003, 0.1], 230.0),
}


def photograph(lens: F64, place: F64, hand: tuple[F64, F64]) -> np.ndarray:
    """Return a picture of the board, on grey: place (6,) in the world, hand the camera's frame."""
    across, up = (count * board.SQUARE for count in board.SQUARES)
    grid = np.array(
        [[x, -y, 0] for x in np.linspace(0, across, 25) for y in np.linspace(0, up, 33)]
    )
    world = Rotation.from_rotvec(place[3:]).apply(grid) + place[:3]
    seen = project(lens, SIZE, (world - hand[0]) @ hand[1])
    drawn = board.drawn()
    dots = grid[:, :2] * [1, -1] / board.SQUARE * drawn.shape[1] / board.SQUARES[0]
    warp, _ = cv2.findHomography(dots - 0.5, seen - 0.5)  # the lens bends little
    fine = np.diag([4.0, 4.0, 1.0]) @ warp
    large = cv2.warpPerspective(drawn, fine, [4 * side for side in SIZE], borderValue=150)
    small = cv2.resize(large, SIZE, interpolation=cv2.INTER_AREA)
    return np.repeat(small[:, :, None], 3, axis=2)


def write(root: Path, *, shown: bool = True, scale: float = 1.0, rests: int = RESTS) -> Path:
    """Write a dataset; `scale`: of the print."""
    hand, rng = HandPoses(ROBOT), np.random.default_rng(0)
    still = np.zeros(3), np.eye(3)
    episodes: list[EpisodeData] = []
    for _ in range(PLACES):
        yaw = rng.uniform(-0.6, 0.6)
        turn = Rotation.from_rotvec([0, 0, yaw])
        middle = np.array([rng.uniform(0.2, 0.24), rng.uniform(-0.03, 0.03), 0.0])
        place = np.array([*(middle + turn.apply([-0.09, 0.12, 0])), 0, 0, yaw])
        states: list[F64] = []
        pictures: dict[str, list[np.ndarray]] = {name: [] for name in CAMERAS}
        for _ in range(rests):
            joints = PLAIN + rng.uniform(-0.3, 0.3, 5)
            for name, lens in CAMERAS.items():
                frame = hand.pose(joints) if name == "wrist" else still
                scaled = (frame[0] / scale, frame[1])
                closer = lens / np.where(np.isin(np.arange(9), (3, 4, 5)), scale, 1.0)
                seen = photograph(closer, place, scaled)
                pictures[name] += [seen if shown else np.full_like(seen, 150)] * (STILL + 1)
            units = np.append(np.degrees(joints - ZEROS), 10.0)
            states += [units] * STILL + [units + 5]
        columns = {"observation.state": np.array(states, np.float32)}
        columns |= {f"observation.images.{name}": np.array(one) for name, one in pictures.items()}
        episodes.append(EpisodeData(columns, ["look"] * len(states)))
    names = [*ROBOT.joint_names]
    features = {"observation.state": {"dtype": "float32", "shape": [len(names)], "names": names}}
    picture = {
        "dtype": "image",
        "shape": [*SIZE[::-1], 3],
        "names": ["height", "width", "channels"],
    }
    features |= {f"observation.images.{name}": picture for name in CAMERAS}
    write_episodes(episodes, root, features, FPS, "so_follower")
    return root
