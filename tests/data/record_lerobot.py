"""Record through LeRobot's own writer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

CAMERAS = ("observation.images.front", "observation.images.wrist")
SIZE = (64, 96, 3)


def record(root: Path, kind: str, episodes: int) -> None:
    """Episodes of numbers, text and two cameras. kind: of these, `video` or `image`."""
    table: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "c"]},
        "action": {"dtype": "float32", "shape": (2,), "names": {"motors": ["x", "y"]}},
        "note": {"dtype": "string", "shape": (1,), "names": None},
        "flag": {"dtype": "bool", "shape": (1,), "names": None},
        **{one: {"dtype": kind, "shape": SIZE, "names": ["height", "width", "channels"]} for one in CAMERAS},
    }
    dataset: Any = LeRobotDataset.create("a/b", 10, table, root=root, robot_type="so100", use_videos=kind == "video")
    rng = np.random.default_rng(0)
    for episode in range(episodes):
        for t in range(15 + episode):
            row: dict[str, Any] = {"task": f"task {episode % 2}", "note": f"frame {t}", "flag": np.array([t % 2 == 0])}
            row |= {key: rng.normal(size=table[key]["shape"]).astype(np.float32) for key in list(table)[:2]}
            for camera in CAMERAS:
                row[camera] = np.zeros(SIZE, np.uint8)
                row[camera][:, 5 * t % 80 : 5 * t % 80 + 10, episode % 3] = 255
            dataset.add_frame(row)
        dataset.save_episode()
    dataset.finalize()
