"""Cameras: every row's picture is where the dataset says, and comes back."""

import dataclasses
import json
import os
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.bridges.doctor.examine import examine_folder
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.build import merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.video_config import VideoConfig
from manip_il.errors import UnknownName, UsageError
from manip_il.learn.checkpoint import Origin
from manip_il.mdp import Episode

from ..damage import digests
from ..pictures import (
    assert_comes_back,
    count_frames,
    episode_frames,
    numbered_episodes,
    numbers_of,
    video_rows,
    write,
)

FRONT, WRIST = "observation.images.front", "observation.images.wrist"


@pytest.fixture(scope="module")
def root(
    tmp_path_factory: pytest.TempPathFactory, filmed: list[Episode], two: s.EnvironmentSpec
) -> Path:
    return write(filmed, tmp_path_factory.mktemp("filmed") / "lift", two)


def test_every_frame_comes_back_in_its_place_nearly_as_it_was(root, filmed):
    assert_comes_back(root, filmed)
    assert numbers_of(episode_frames(root, FRONT, 2)) == list(range(8, 21))
    assert numbers_of(episode_frames(root, WRIST, 1)) == [28]
    frames = episode_frames(root, FRONT, 0)
    assert frames.dtype == np.uint8
    assert np.abs(frames.astype(float) - filmed[0].columns[FRONT]).mean() < 2  # of 255 levels


def test_a_new_file_starts_between_episodes(tmp_path, make_episode, two):
    episodes = numbered_episodes(make_episode, two, 9)
    write(episodes, tmp_path / "small", two, size=0.001)
    rows = video_rows(tmp_path / "small")
    assert sum(path.parts[-3] == FRONT for path in rows) > 2
    assert {path: count_frames(path) for path in rows} == rows
    assert sorted((tmp_path / "small").rglob("*.mp4")) == sorted(rows)
    assert_comes_back(tmp_path / "small", episodes)


@pytest.mark.system
def test_timestamps_are_exact(root, two):
    path = next(iter(video_rows(root)))
    with closing(av.open(str(path))) as container:
        stream = container.streams.video[0]
        times = [
            packet.pts * packet.time_base
            for packet in container.demux(stream)
            if packet.pts is not None
        ]
        assert stream.average_rate == two.fps  # by which torchcodec finds a frame
    assert times == [Fraction(number, two.fps) for number in range(21)]


@pytest.mark.parametrize("fps", [12.5, 23.976, 29.97002997])
def test_a_rate_that_is_not_whole_is_that_of_rows_videos_and_policies(filmed, two, tmp_path, fps):
    root = write(filmed, tmp_path / "lift", dataclasses.replace(two, fps=fps))
    assert json.loads((root / layout.INFO).read_text())["fps"] == fps
    # refuses a frame that is off by a tenth of a millisecond
    theirs: Any = LeRobotDataset("local/lift", root=root)
    pictures = np.stack([255 * theirs[row][FRONT].numpy().transpose(1, 2, 0) for row in range(21)])
    assert numbers_of(pictures) == list(range(21))
    assert not [one for one in examine_folder(root) if one.is_error]
    (root / layout.OURS).unlink()
    assert Origin.of(Dataset.open(root).spec).fps == fps


def test_the_same_episodes_give_the_same_bytes(root, tmp_path, filmed, two):
    write(filmed, tmp_path / "again", two)
    assert digests(root) == digests(tmp_path / "again")


def test_statistics_of_pictures_are_those_of_every_pixel(root, filmed):
    stats = json.loads((root / layout.STATS).read_text())[FRONT]
    assert stats["count"] == [21]
    pixels = (
        np.concatenate([episode.columns[FRONT] for episode in filmed])
        .reshape(-1, 3)
        .astype(np.float64)
        / 255
    )
    expected = {"min": pixels.min(axis=0), "max": pixels.max(axis=0), "mean": pixels.mean(axis=0)}
    expected |= {"std": pixels.std(axis=0)}
    for name, share in layout.QUANTILES.items():
        parts = [episode.columns[FRONT].reshape(-1, 3) / 255 for episode in filmed]
        each = [
            len(part) * np.quantile(part, share, axis=0, method="inverted_cdf") for part in parts
        ]
        expected[name] = sum(each) / len(pixels)
    for name, values in expected.items():
        assert np.shape(stats[name]) == (3, 1, 1)
        np.testing.assert_allclose(np.ravel(stats[name]), values, rtol=1e-10, err_msg=name)


def test_settings_that_an_encoder_refuses_are_one_line(filmed, two, tmp_path):
    with pytest.raises(UsageError, match=r"cannot encode 96 x 72 pictures .*expected even"):
        write(filmed, tmp_path / "odd", two, video=VideoConfig(preset="slowest"))
    assert not (tmp_path / "odd").exists()


def test_an_encoder_makes_no_thread_a_real_time_one(filmed, two, tmp_path):
    write(filmed, tmp_path / "lift", two, video=VideoConfig(vcodec="libsvtav1"))
    assert {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")} == {
        os.SCHED_OTHER
    }


def test_datasets_with_cameras_become_one_with_the_same_pictures(tmp_path, root):
    info = merge_datasets([root, root], tmp_path / "merged", provenance={"made": "here"})
    assert (info.episodes, info.frames) == (6, 42)
    assert not [one for one in examine_folder(tmp_path / "merged") if one.is_error]
    assert Dataset.open(tmp_path / "merged").spec == Dataset.open(root).spec
    assert Dataset.open(tmp_path / "merged").provenance["made"] == "here"
    for camera in (FRONT, WRIST):
        for episode in range(6):
            here, there = (
                episode_frames(tmp_path / "merged", camera, episode),
                episode_frames(root, camera, episode % 3),
            )
            np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize("video", [True, False])
def test_a_dataset_with_cameras_tells_of_itself_also_by_lerobots_own_description(
    filmed, two, tmp_path, video
):
    two = dataclasses.replace(two, video=video)
    root = write(filmed, tmp_path / "lift", two)
    assert (Dataset.open(root).cameras, Dataset.open(root).spec) == ([FRONT, WRIST], two)
    with pytest.raises(UnknownName, match=r"did you mean 'observation\.images\.front'"):
        episode_frames(root, "observation.images.fron", 0)
    (root / layout.OURS).unlink()  # as LeRobot's tools do
    theirs = Dataset.open(root).spec
    assert (theirs.cameras, theirs.image_size, theirs.video) == (two.cameras, two.image_size, video)
