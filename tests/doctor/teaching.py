"""Datasets as a teacher records them: joints that follow their targets, a gripper, cameras that
see the hand move.
"""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.data import schema as s
from manip_il.data.build import build
from manip_il.data.journal import Journal
from manip_il.mdp import Episode
from manip_il.worlds.fingerprint import environment_fingerprint

EPISODES, SIZE, CAMERAS = 12, (48, 64), ("front", "wrist")
NAMES = ("pan", "lift", "elbow", "wrist", "gripper")
AXES = ["height", "width", "channels"]
Columns = dict[str, np.ndarray]


def make(root: Path, number: int) -> Path:
    """One of twenty datasets: ours and LeRobot's, with and without cameras, of several rates and
    forms of names.
    """
    rng, fps = np.random.default_rng(number), (20, 30, 15)[number % 3]
    home, way = (rng.uniform(0.4, high, 4) * rng.choice([-1, 1], 4) for high in (1.5, 1.0))
    scene = rng.integers(30, 220, (len(CAMERAS), 6, 8, 3)) if number % 4 > 1 else None
    episodes = [_teach(rng, fps, home, way, scene) for _ in range(EPISODES)]
    if number % 2:
        return _write_ours(root, episodes, fps)
    names = (list(NAMES), None, {"motors": [f"{name}.pos" for name in NAMES]})[number // 2 % 3]
    return _write_theirs(root, episodes, fps, "video" if number % 8 == 2 else "image", names)


def _teach(
    rng: np.random.Generator, fps: int, home: np.ndarray, way: np.ndarray, scene: Any
) -> Columns:
    """An episode that begins near one pose, goes to a place of its own, closes the gripper and
    comes some way back.
    """
    start = home + rng.normal(0, 0.01, 4)
    goal = start + way * rng.uniform(0.6, 1.4, 4)
    first, second = int(fps * rng.uniform(1.2, 1.8)), int(0.8 * fps)
    share = np.concatenate([_smooth(first), 1 - 2 / 3 * _smooth(second)])
    closed = np.arange(len(share)) > first - fps // 3
    action = np.column_stack([start + share[:, None] * (goal - start), np.where(closed, 0.0, 0.08)])
    state, now = np.empty_like(action), np.array([*start, 0.08])
    for frame, told in enumerate(action):
        state[frame] = now
        now = now + (np.maximum(told, [-np.inf] * 4 + [0.03]) - now) * [0.6, 0.6, 0.6, 0.6, 0.4]
    state[:, :4] += rng.normal(0, 2e-4, (len(state), 4))
    columns: Columns = {s.STATE: state.astype(np.float32), s.ACTION: action.astype(np.float32)}
    for number, camera in enumerate(CAMERAS if scene is not None else ()):
        columns[s.IMAGES + camera] = np.stack(
            [_picture(scene[number], one, number) for one in state]
        )
    return columns


def _smooth(length: int) -> np.ndarray:
    share = np.linspace(0, 1, length)
    return share**2 * (3 - 2 * share)


def _picture(scene: np.ndarray, joints: np.ndarray, number: int) -> np.ndarray:
    """The scene, and a hand of another colour a camera where the joints are."""
    picture = np.kron(scene, np.ones((8, 8, 1))).astype(np.uint8)
    across, down = (int(24 + 12 * np.clip(joint, -2, 2)) for joint in joints[:2])
    picture[down % 36 : down % 36 + 12, across : across + 16] = (
        (250, 40, 40) if number else (40, 250, 40)
    )
    return picture


def _write_ours(root: Path, episodes: list[Columns], fps: int) -> Path:
    """A dataset beside its journals, of this program's own writer."""
    cameras, size = (CAMERAS, SIZE) if len(episodes[0]) > 2 else ((), (0, 0))
    about = ("arm", "put", fps, NAMES, ("object.x", "object.y"), 7, "Put it there.")
    spec = s.EnvironmentSpec(*about, cameras=cameras, image_size=size)
    journal = Journal(
        root.with_name(f"{root.name}.journals"), spec, environment_fingerprint(b"", {})
    )
    for seed, columns in enumerate(episodes):
        length, rng = len(columns[s.STATE]), np.random.default_rng(seed)
        empty = {key: np.zeros((length, *one["shape"]), one["dtype"]) for key, one in s.features(spec).items()
                 if key not in columns}  # fmt: skip
        table = {key: columns.get(key, empty.get(key)) for key in s.features(spec)}
        table[s.ENVIRONMENT_STATE][:] = rng.normal(size=2)
        table[s.EXECUTED_ACTION], table[s.SEED][:], table[s.LABEL_VALID][:] = (
            table[s.ACTION],
            seed,
            1,
        )
        table[s.SUCCESS][-1] = table[s.DONE][-1] = True
        journal.write(Episode(seed, table, True, True))
    build(journal.folder, root)
    return root


def _write_theirs(root: Path, episodes: list[Columns], fps: int, kind: str, names: Any) -> Path:
    """A dataset of LeRobot's writer. kind: dtype of its cameras."""
    features: dict[str, Any] = {
        key: {"dtype": kind, "shape": (*SIZE, 3), "names": AXES} for key in episodes[0]
    }
    features |= {
        key: {"dtype": "float32", "shape": (5,), "names": names} for key in (s.STATE, s.ACTION)
    }
    dataset: Any = LeRobotDataset.create(
        "a/b", fps, features, root=root, use_videos=kind == "video"
    )
    for one in episodes:
        for row in zip(*one.values(), strict=True):
            dataset.add_frame(dict(zip(one, row, strict=True)) | {"task": "Put it\nthere."})
        dataset.save_episode()
    dataset.finalize()
    return root


def encode(root: Path, key: str, pictures: np.ndarray, fps: float) -> None:
    """Write a camera's one video file again."""
    [path] = (root / "videos" / key).rglob("*.mp4")
    with av.open(path, "w") as container:
        stream: Any = container.add_stream(
            "h264", rate=Fraction(fps).limit_denominator(1001), options={"g": "2"}
        )
        stream.height, stream.width = pictures.shape[1:3]
        for one in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(one, format="rgb24")))
        container.mux(stream.encode(None))
