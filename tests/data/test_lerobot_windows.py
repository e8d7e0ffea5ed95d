"""LeRobot's own reading as the fallback, and as the judge of the frame cache. It imports torch: some seconds."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.frame_cache import open_frame_cache
from manip_il.data.lerobot_read import camera_keys
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError
from manip_il.mdp import Episode

from ..pictures import numbered_episodes, numbers_of, write

pytestmark = pytest.mark.slow
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
RECORDED = ("video", "image")


@pytest.fixture(scope="module")
def five(make_episode: Callable[..., Episode], two: s.RobotTaskSpec) -> list[Episode]:
    return numbered_episodes(make_episode, two, 5)


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory, five: list[Episode], two: s.RobotTaskSpec) -> dict[str, Path]:
    """Ours with either codec, in several files; what LeRobot records; what it makes of two by aggregating."""
    from lerobot.datasets.aggregate import aggregate_datasets

    from .record_lerobot import main as record

    folder = tmp_path_factory.mktemp("datasets")
    for codec in ("h264", "libsvtav1"):
        write(five, folder / codec, two, video=VideoConfig(codec), video_files_size_in_mb=0.001)
    os.environ.setdefault("SVT_LOG", "1")  # or the encoder tells its life
    for kind in RECORDED:
        record(folder / kind, kind, 3, "finalize")
    pair = [folder / "video", folder / "video"]
    aggregate_datasets(["a/one", "a/two"], "a/all", roots=pair, aggr_root=folder / "aggregated")
    return {path.name: path for path in folder.iterdir()}


def windows(root: Path, deltas: dict[str, list[float]] | None = None, **options: Any) -> Any:
    from manip_il.data.lerobot_library import lerobot_windows

    return lerobot_windows(root, "a/b", deltas, **options)


def cached(root: Path, folder: Path) -> dict[str, np.ndarray]:
    frames = open_frame_cache(root, camera_keys(root), max_bytes=10**9, folder=folder)
    assert frames is not None
    return frames


@pytest.mark.parametrize("name", ["h264", "libsvtav1", *RECORDED, "aggregated"])
def test_the_cache_is_bit_equal_to_what_lerobot_gives(roots, name, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = roots[name]
    frames = cached(root, tmp_path)
    plain: Any = LeRobotDataset("a/b", root=root)
    fallback = windows(root)
    assert list(frames) == [FRONT, WRIST]
    assert len(plain) == len(fallback) == len(frames[FRONT]) > 20
    for row in range(len(plain)):
        theirs, ours = plain[row], fallback[row]
        assert int(theirs["index"]) == row
        for key, values in frames.items():
            assert theirs[key].dtype.is_floating_point
            np.testing.assert_array_equal((theirs[key] * 255).numpy(), values[row].astype(np.float32))
            np.testing.assert_array_equal(ours[key].numpy(), values[row], strict=True)


def test_windows_in_time_stop_at_an_episodes_borders(roots, five, two):
    step = 1 / two.fps
    dataset = windows(roots["h264"], {FRONT: [-step, 0], s.STATE: [-step, 0], s.ACTION: [0, step, 2 * step]})
    state, action = five[2].columns[s.STATE], five[2].columns[s.ACTION]
    first, last = dataset[8], dataset[20]
    assert first[FRONT].shape == (2, 3, 72, 96)
    assert numbers_of(first[FRONT].permute(0, 2, 3, 1).numpy()) == [8, 8]
    assert numbers_of(dataset[9][FRONT].permute(0, 2, 3, 1).numpy()) == [8, 9]
    assert first[f"{FRONT}_is_pad"].tolist() == first[f"{s.STATE}_is_pad"].tolist() == [True, False]
    np.testing.assert_array_equal(first[s.STATE].numpy(), [state[0], state[0]])
    np.testing.assert_array_equal(first[s.ACTION].numpy(), action[:3])
    np.testing.assert_array_equal(last[s.STATE].numpy(), state[-2:])
    np.testing.assert_array_equal(last[s.ACTION].numpy(), [action[-1]] * 3)
    one_frame = dataset[7]
    assert one_frame["action_is_pad"].tolist() == last["action_is_pad"].tolist() == [False, True, True]


def test_a_selection_of_episodes(roots, five):
    dataset = windows(roots["h264"], episodes=[2])
    assert len(dataset) == 13
    assert numbers_of(dataset[0][FRONT].permute(1, 2, 0).numpy()[None]) == [8]
    np.testing.assert_array_equal(dataset[0][s.ACTION].numpy(), five[2].columns[s.ACTION][0])


def test_a_loader_with_processes_of_its_own(roots, tmp_path):
    import torch

    root = roots["video"]
    loader = torch.utils.data.DataLoader(
        windows(root), batch_size=8, num_workers=1, multiprocessing_context="forkserver"
    )
    pictures = torch.cat([batch[WRIST] for batch in loader])
    np.testing.assert_array_equal(pictures.numpy(), cached(root, tmp_path)[WRIST])


def test_nothing_is_asked_of_the_hub(roots, tmp_path, monkeypatch):
    import socket

    def refuse(*_: object) -> None:
        raise AssertionError("a connection was tried")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    whole = roots["h264"]
    assert len(windows(whole)) == 29
    with pytest.raises(ManipError, match=r"not a complete LeRobot dataset: no file matches meta/info\.json"):
        windows(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()
    for name, message in ((layout.TASKS, "no file matches meta/tasks"), ("videos", "lacks data or video files")):
        copy = tmp_path / name.replace("/", "-")
        shutil.copytree(whole, copy, ignore=shutil.ignore_patterns(Path(name).name))
        with pytest.raises(ManipError, match=message):
            windows(copy)
