"""Datasets through LeRobot's own code: for features that only its writer knows, and for training with its loader."""

from __future__ import annotations

import contextlib
import io
import shutil
from collections.abc import Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, override

import numpy as np
from datasets.utils.logging import disable_progress_bar, enable_progress_bar, is_progress_bar_enabled
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import IMAGENET_STATS
from numpy.typing import NDArray

from manip_il.data.lerobot_layout import EPISODES_FILES, INFO, TASKS
from manip_il.data.lerobot_read import check_dataset
from manip_il.errors import ManipError, MismatchError

Frame = dict[str, Any]  # column -> array of the feature's dtype and shape, or text; and `task`


def write_with_library(
    root: Path,
    fps: int,
    robot_type: str | None,
    features: dict[str, dict[str, Any]],
    episodes: Iterable[Iterable[Frame]],
) -> Generator[int]:
    """Write a dataset to `root`, which must not exist; yield every episode's number of frames.

    Not atomic: write into a `new_folder`. Tasks are numbered as they first appear. The repository's name is not
    stored anywhere.
    """
    with_video = any(feature["dtype"] == "video" for feature in features.values())
    dataset = LeRobotDataset.create(
        f"local/{root.name}", fps, features, root=root, robot_type=robot_type, use_videos=with_video
    )
    try:
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
    except BaseException:
        with contextlib.suppress(Exception):
            dataset.finalize()  # else it writes when it is collected, into the folder that was removed
        raise
    dataset.finalize()
    shutil.rmtree(root / "images", ignore_errors=True)  # empty folders: the pictures are in the data by now


def _save(dataset: LeRobotDataset) -> None:
    """Save an episode without LeRobot's progress bar."""
    enabled = is_progress_bar_enabled()
    disable_progress_bar()
    try:
        dataset.save_episode(parallel_encoding=False)
    finally:
        if enabled:
            enable_progress_bar()


def join_datasets(roots: Sequence[Path], root: Path, repo_id: str) -> None:
    """Join datasets into `root`, which must not exist, by LeRobot; every video stays a file of its own."""
    for source in roots:
        check_dataset(source)
    names = [f"local/{source.name}_{i}" for i, source in enumerate(roots)]
    with contextlib.redirect_stderr(io.StringIO()):  # its progress bars
        aggregate_datasets(names, repo_id, roots=list(roots), aggr_root=root, concatenate_videos=False)


class Metadata(LeRobotDatasetMetadata):
    """LeRobot's metadata of one dataset, or of several as one; `roots` are their folders.

    learnt_actions: what is learnt in place of the column `action`, (N, n), where that is converted first.
    """

    roots: tuple[Path, ...] = ()
    learnt_actions: NDArray[np.float32] | None = None


def read_metadata(*roots: Path) -> Metadata:
    """Return LeRobot's own description of a dataset, or of several as one, from which its factories build policies.

    The cameras' statistics are ImageNet's, as `lerobot-train` takes them by default. Raises `ManipError` for a folder
    that is no dataset, `MismatchError` for several of different features or tasks.
    """
    metas = [_metadata(root) for root in roots]
    first = metas[0]
    first.roots = roots
    for root, meta in zip(roots[1:], metas[1:], strict=True):
        for what, ours, theirs in zip(("features", "rate", "tasks"), _nature(first), _nature(meta), strict=True):
            if ours != theirs:
                raise MismatchError(what, str(roots[0]), ours, str(root), theirs)
    stats = [meta.stats for meta in metas if meta.stats is not None]
    joined = stats[0] if len(metas) == 1 else aggregate_stats(stats)
    for key in first.camera_keys:
        joined[key] |= {name: np.asarray(values, np.float32) for name, values in IMAGENET_STATS.items()}
    first.stats = joined
    first.info.total_episodes = sum(meta.total_episodes for meta in metas)
    first.info.total_frames = sum(meta.total_frames for meta in metas)
    return first


def _nature(meta: LeRobotDatasetMetadata) -> tuple[list[str], int, list[str]]:
    return list(meta.features), meta.fps, [] if meta.tasks is None else list(map(str, meta.tasks.index))


def _metadata(root: Path) -> Metadata:
    check_dataset(root)  # else LeRobot would request what is not there from the Hub
    meta = Metadata(f"local/{root.name}", root=root)
    if meta.stats is None:
        raise ManipError(f"{root} has no statistics (meta/stats.json); run `manip-il doctor` to see what is left")
    return meta


def lerobot_windows(
    root: Path,
    repo_id: str,
    delta_timestamps: Mapping[str, Sequence[float]] | None,
    episodes: Sequence[int] | None = None,
) -> LeRobotDataset:
    """Open a dataset with LeRobot's own reader, for a `DataLoader`; it decodes on access, and never uses the Hub.

    A picture is uint8 (3, height, width), the same bytes as in the frame cache, and (K, 3, height, width) where
    `delta_timestamps` [s] asks for a window; episodes: the ones to read, all by default. Raises `ManipError` for a
    folder that is no dataset or that lacks files.
    """
    for pattern in (INFO, TASKS, EPISODES_FILES):  # LeRobot would request them from the Hub
        if not any(root.glob(pattern)):
            raise ManipError(f"{root} is not a complete LeRobot dataset: no file matches {pattern}")
    check_dataset(root)
    return _LocalDataset(
        repo_id,
        root=root,
        episodes=None if episodes is None else list(episodes),
        delta_timestamps=None if delta_timestamps is None else {key: list(v) for key, v in delta_timestamps.items()},
        revision="local",  # no version, so that LeRobot does not look for one on the Hub
        image_transforms=_to_bytes,
        return_uint8=True,
    )


class _LocalDataset(LeRobotDataset):
    @override
    def _download(self, download_videos: bool = True, *, token: str | bool | None = None) -> None:
        raise ManipError(f"{self.root} lacks data or video files of its episodes; run `manip-il doctor` to see which")


def _to_bytes(pictures: Any) -> Any:
    """A tensor of levels as bytes: videos come so, images that are stored one by one in [0, 1]."""
    return pictures.mul(255).round().byte() if pictures.is_floating_point() else pictures
