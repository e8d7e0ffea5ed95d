"""Datasets as a teacher records them: joints that follow their targets, a gripper, cameras that see the hand move."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from manip_il.data import schema as s
from manip_il.data.fingerprint import environment_fingerprint
from manip_il.data.lerobot_library import write_with_library
from manip_il.data.lerobot_write import write_dataset
from manip_il.mdp import Episode

EPISODES, SIZE, CAMERAS = 12, (48, 64), ("front", "wrist")
NAMES = ("pan", "lift", "elbow", "wrist", "gripper")
Columns = dict[str, np.ndarray]


def teach(rng: np.random.Generator, fps: int, cameras: bool) -> list[Columns]:
    """Episodes that begin near one pose, go to a place of their own, close the gripper and come some way back."""
    home = rng.uniform(0.4, 1.5, 4) * rng.choice([-1, 1], 4)
    way = rng.uniform(0.4, 1.0, 4) * rng.choice([-1, 1], 4)
    scene = rng.integers(30, 220, (len(CAMERAS), *SIZE, 3))
    return [_episode(rng, fps, home, way, scene if cameras else None) for _ in range(EPISODES)]


def _episode(rng: np.random.Generator, fps: int, home: np.ndarray, way: np.ndarray, scene: Any) -> Columns:
    start = home + rng.normal(0, 0.01, 4)
    goal = start + way * rng.uniform(0.6, 1.4, 4)
    legs = [(start, goal, int(fps * rng.uniform(1.2, 1.8))), (goal, (start + 2 * goal) / 3, int(0.8 * fps))]
    arm = np.concatenate([_smooth(a, b, length) for a, b, length in legs])
    closed = np.arange(len(arm)) > legs[0][2] - fps // 3
    action = np.column_stack([arm, np.where(closed, 0.0, 0.08)])
    state = np.empty_like(action)
    now = np.array([*start, 0.08])
    for frame, told in enumerate(action):
        state[frame] = now
        now = now + (np.maximum(told, [-np.inf] * 4 + [0.03]) - now) * [0.6, 0.6, 0.6, 0.6, 0.4]
    state[:, :4] += rng.normal(0, 2e-4, (len(state), 4))
    columns: Columns = {s.STATE: state.astype(np.float32), s.ACTION: action.astype(np.float32)}
    for number, camera in enumerate(CAMERAS if scene is not None else ()):
        columns[s.IMAGES + camera] = np.stack([_picture(scene[number], one, number) for one in state])
    return columns


def _smooth(start: np.ndarray, stop: np.ndarray, length: int) -> np.ndarray:
    share = np.linspace(0, 1, length)[:, None]
    return start + (stop - start) * share**2 * (3 - 2 * share)


def _picture(scene: np.ndarray, joints: np.ndarray, number: int) -> np.ndarray:
    """The scene, and a hand of another colour a camera where the joints are."""
    picture = np.kron(scene[::8, ::8], np.ones((8, 8, 1))).astype(np.uint8)
    across, down = (int(24 + 12 * np.clip(joint, -2, 2)) for joint in joints[:2])
    picture[down % 36 : down % 36 + 12, across : across + 16] = (250, 40, 40) if number else (40, 250, 40)
    return picture


def write_ours(root: Path, episodes: list[Columns], fps: int, instruction: str = "Put it there.") -> Path:
    """A dataset of this program's own writer."""
    first = episodes[0]
    cameras = tuple(key.removeprefix(s.IMAGES) for key in first if key.startswith(s.IMAGES))
    spec = s.RobotTaskSpec(
        *("arm", "put", fps, NAMES, ("object.x", "object.y"), 7, instruction), cameras=cameras,
        image_size=SIZE if cameras else (0, 0),
    )  # fmt: skip
    made = (_ours(spec, seed, columns) for seed, columns in enumerate(episodes))
    write_dataset(made, root, spec, repo_id="a/b", fingerprint=environment_fingerprint(b"", {}))
    return root


def _ours(spec: s.RobotTaskSpec, seed: int, columns: Columns) -> Episode:
    length, rng = len(columns[s.STATE]), np.random.default_rng(seed)
    table: Columns = {}
    for key, feature in s.features(spec).items():
        shape = (length, *feature["shape"])
        table[key] = columns.get(key, np.zeros(shape, feature["dtype"] if feature["dtype"] != "video" else "uint8"))
    table[s.ENVIRONMENT_STATE][:] = rng.normal(size=2)
    table[s.EXECUTED_ACTION], table[s.SEED][:], table[s.LABEL_VALID][:] = table[s.ACTION], seed, 1
    table[s.SUCCESS][-1] = table[s.DONE][-1] = True
    return Episode(seed, table, True, True)


def write_theirs(root: Path, episodes: list[Columns], fps: int, kind: str, names: Any) -> Path:
    """A dataset of LeRobot's writer. kind: dtype of its cameras."""
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": (5,), "names": names} for key in (s.STATE, s.ACTION)
    } | {
        key: {"dtype": kind, "shape": (*SIZE, 3), "names": ["height", "width", "channels"]}
        for key in episodes[0]
        if key.startswith(s.IMAGES)
    }  # fmt: skip
    frames = ([{"task": "Put it\nthere."} | {key: one[t] for key, one in columns.items()}
               for t in range(len(columns[s.STATE]))] for columns in episodes)  # fmt: skip
    list(write_with_library(root, fps, None, features, frames))
    return root


def make(root: Path, number: int) -> Path:
    """One of twenty datasets: ours and LeRobot's, with and without cameras, of several rates and forms of names."""
    rng, fps, cameras = np.random.default_rng(number), (20, 30, 15)[number % 3], number % 4 > 1
    episodes = teach(rng, fps, cameras)
    if number % 2:
        return write_ours(root, episodes, fps)
    names = (list(NAMES), None, {"motors": [f"{name}.pos" for name in NAMES]})[number // 2 % 3]
    return write_theirs(root, episodes, fps, "video" if number % 8 == 2 else "image", names)


def encode(root: Path, key: str, pictures: np.ndarray, fps: float) -> None:
    """Write a camera's one video file again."""
    [path] = (root / "videos" / key).rglob("*.mp4")
    with av.open(path, "w") as container:
        stream: Any = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1001), options={"g": "2"})
        stream.height, stream.width = pictures.shape[1:3]
        for one in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(one, format="rgb24")))
        container.mux(stream.encode(None))
