"""Record through LeRobot's own writer, in a process of its own: ROOT KIND EPISODES END.

KIND: state, video, image, or matrix (with one, and with numbers far from zero).
END: finalize; kill (in the next episode); resume (what is there, then kill).
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

CAMERAS = ("observation.images.front", "observation.images.wrist")
SIZE = (64, 96, 3)


def features(kind: str) -> dict[str, Any]:
    table: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "c"]},
        "action": {"dtype": "float32", "shape": (2,), "names": {"motors": ["x", "y"]}},
        "note": {"dtype": "string", "shape": (1,), "names": None},
        "flag": {"dtype": "bool", "shape": (1,), "names": None},
    }
    if kind == "matrix":
        table["grid"] = {"dtype": "float32", "shape": (2, 3), "names": None}
    if kind in ("video", "image"):
        names = ["height", "width", "channels"]
        table |= {camera: {"dtype": kind, "shape": SIZE, "names": names} for camera in CAMERAS}
    return table


def frame(table: dict[str, Any], kind: str, episode: int, t: int, rng: np.random.Generator) -> dict[str, Any]:
    row: dict[str, Any] = {"task": f"task {episode % 2}"}
    for key, feature in table.items():
        if feature["dtype"] == "float32":
            values = rng.normal(size=feature["shape"])
            row[key] = (1000 + values if kind == "matrix" else 100 * values).astype(np.float32)
        elif feature["dtype"] in ("video", "image"):
            row[key] = np.zeros(SIZE, dtype=np.uint8)
            row[key][:, 5 * t % 80 : 5 * t % 80 + 10, episode % 3] = 255
    return row | {"note": f"frame {t}", "flag": np.array([t % 2 == 0])}


def main(root: Path, kind: str, episodes: int, end: str) -> None:
    table = features(kind)
    if end == "resume":
        dataset = LeRobotDataset.resume("a/b", root=root)
    else:
        video = kind == "video"
        dataset = LeRobotDataset.create("a/b", 10, table, root=root, robot_type="so100", use_videos=video)
    rng = np.random.default_rng(0)
    for episode in range(episodes):
        for t in range(300 if kind == "matrix" else 15 + episode):
            dataset.add_frame(frame(table, kind, episode, t, rng))
        dataset.save_episode()
    if end == "finalize":
        dataset.finalize()
        return
    for t in range(4):
        dataset.add_frame(frame(table, kind, episodes, t, rng))
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), sys.argv[4])
