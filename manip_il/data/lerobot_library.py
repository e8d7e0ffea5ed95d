"""Write a dataset of any features through LeRobot's own writer: slow, but it knows every feature that LeRobot has."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from datasets.utils.logging import disable_progress_bar, enable_progress_bar, is_progress_bar_enabled
from lerobot.datasets.lerobot_dataset import LeRobotDataset

Frame = dict[str, Any]  # column -> array of the feature's dtype and shape, or text; and `task`


def write_with_library(
    root: Path,
    fps: int,
    robot_type: str | None,
    features: dict[str, dict[str, Any]],
    episodes: Iterable[Iterable[Frame]],
) -> Iterator[int]:
    """Write a dataset to `root`, which must not exist; yield every episode's number of frames.

    Not atomic: write into a `new_folder`. Tasks are numbered as they first appear. The repository's name is not
    stored anywhere.
    """
    with_video = any(feature["dtype"] == "video" for feature in features.values())
    dataset = LeRobotDataset.create(
        f"local/{root.name}", fps, features, root=root, robot_type=robot_type, use_videos=with_video
    )
    for frames in episodes:
        count = 0
        tasks: dict[str, None] = {}
        for frame in frames:
            count += 1
            tasks[frame["task"]] = None
            dataset.add_frame(frame)
        dataset.meta.save_episode_tasks(list(tasks))  # LeRobot would number an episode's tasks in random order
        _save(dataset)
        yield count
    dataset.finalize()
    shutil.rmtree(root / "images", ignore_errors=True)  # empty folders: the pictures are in the data by now


def _save(dataset: LeRobotDataset) -> None:
    """Without the progress bar that it shows for every episode."""
    shown = is_progress_bar_enabled()
    disable_progress_bar()
    try:
        dataset.save_episode(parallel_encoding=False)
    finally:
        if shown:
            enable_progress_bar()
