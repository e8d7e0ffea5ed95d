"""LeRobot's unmodified library is the judge of the cameras that we write, too."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.lerobot_read import read_episodes, read_frames, read_spec
from manip_il.data.lerobot_write import new_dataset, write_dataset
from manip_il.data.video import VideoConfig
from manip_il.mdp import Episode

from ..pictures import number_of, numbered_episodes, numbers_of, with_cameras
from .test_lerobot_library import DATA, EPISODES, REPO, add_episode, load

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def filming(spec: s.RobotTaskSpec) -> s.RobotTaskSpec:
    return with_cameras(spec, "front", "wrist")


@pytest.fixture(scope="module")
def filmed(make_episode: Callable[..., Episode], filming: s.RobotTaskSpec) -> list[Episode]:
    return numbered_episodes(make_episode, filming)


@pytest.fixture(scope="module")
def our_film(tmp_path_factory: pytest.TempPathFactory, filming: s.RobotTaskSpec, filmed: list[Episode]) -> Path:
    root = tmp_path_factory.mktemp("ours") / "film"
    with new_dataset(root, filming, repo_id=REPO, fingerprint={}, video=VideoConfig("libsvtav1")) as writer:
        for episode in filmed:
            writer.add(episode)
        writer.finish()
    return root


@pytest.fixture(scope="module")
def their_film(tmp_path_factory: pytest.TempPathFactory, filming: s.RobotTaskSpec, filmed: list[Episode]) -> Path:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path_factory.mktemp("theirs") / "film"
    dataset = LeRobotDataset.create(
        REPO, fps=filming.fps, features=s.features(filming), root=root, robot_type=filming.robot
    )
    for episode in filmed:
        add_episode(dataset, episode, filming)
    dataset.finalize()
    return root


def test_video_settings_are_the_librarys() -> None:
    from lerobot.configs.video import RGBEncoderConfig

    for ours, theirs in (
        (VideoConfig("libsvtav1"), RGBEncoderConfig()),
        (VideoConfig("libsvtav1", "yuv420p10le", 5, 20, 8), RGBEncoderConfig("libsvtav1", "yuv420p10le", 5, 20, 8)),
        (VideoConfig("h264", crf=30, preset="fast"), RGBEncoderConfig("h264", preset="fast")),
    ):
        for field in dataclasses.fields(ours):
            assert getattr(ours, field.name) == getattr(theirs, field.name), field.name
        options = ours.options()
        options.pop("bf", None)  # ours alone: no frames out of order
        assert options == theirs.get_codec_options(encoder_threads=1, as_strings=True)


def test_a_filmed_datasets_files_equal_those_of_lerobots_writer(our_film: Path, their_film: Path) -> None:
    left, right = (json.loads((root / layout.INFO).read_text()) for root in (our_film, their_film))
    assert left == right
    left, right = (
        {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()} for root in (our_film, their_film)
    )
    assert left == right | {layout.OURS}
    for name in (DATA, EPISODES, layout.TASKS):
        assert pq.read_schema(our_film / name).equals(pq.read_schema(their_film / name))
    assert pq.read_table(our_film / DATA).equals(pq.read_table(their_film / DATA))


def test_a_filmed_datasets_episodes_equal_those_of_lerobots_writer(our_film: Path, their_film: Path) -> None:
    left, right = (pq.read_table(root / EPISODES).to_pylist() for root in (our_film, their_film))
    for mine, yours in zip(left, right, strict=True):
        for key, value in yours.items():
            if isinstance(value, list) and not key.startswith("stats/"):
                assert mine[key] == value, key
            else:
                np.testing.assert_allclose(mine[key], value, rtol=1e-5, atol=2e-3, err_msg=key)


def test_pictures_equal_those_of_lerobots_writer(our_film: Path, their_film: Path, filming: s.RobotTaskSpec) -> None:
    for key in filming.image_keys:
        for episode in range(3):
            ours, theirs = (read_frames(root, key, episode) for root in (our_film, their_film))
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("backend", ["pyav", "torchcodec"])
@pytest.mark.parametrize("file_size", [200.0, 0.001])
def test_lerobot_decodes_the_right_pictures(
    tmp_path: Path,
    make_episode: Callable[..., Episode],
    filming: s.RobotTaskSpec,
    backend: str,
    file_size: float,
) -> None:
    episodes = numbered_episodes(make_episode, filming, 6)
    root = tmp_path / "film"
    with new_dataset(root, filming, repo_id=REPO, fingerprint={}, video_files_size_in_mb=file_size) as writer:
        for episode in episodes:
            writer.add(episode)
        writer.finish()
    assert (len(list(root.rglob("*.mp4"))) > 2) == (file_size < 1)
    step = 1 / filming.fps
    dataset = load(root, video_backend=backend, delta_timestamps={key: [-step, 0] for key in filming.image_keys})
    index = 0
    for episode in episodes:
        for t in range(len(episode)):
            item = dataset[index]
            for key in filming.image_keys:
                expected = numbers_of(episode.columns[key][[max(t - 1, 0), t]])
                seen = (item[key].permute(0, 2, 3, 1).numpy() * 255).round()
                assert numbers_of(seen) == expected, (index, key)
            index += 1
    assert index == len(dataset)


def test_lerobots_own_film_reads_as_ours(their_film: Path, filmed: list[Episode], filming: s.RobotTaskSpec) -> None:
    assert read_spec(their_film).image_keys == filming.image_keys
    for mine, yours in zip(read_episodes(their_film), filmed, strict=True):
        for key in filming.image_keys:
            assert numbers_of(mine.columns[key]) == numbers_of(yours.columns[key])


def test_lerobot_resumes_filming_onto_ours(tmp_path: Path, filmed: list[Episode], filming: s.RobotTaskSpec) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "resumed"
    write_dataset(filmed[:2], root, filming, repo_id=REPO, fingerprint={})
    dataset = LeRobotDataset.resume(REPO, root=root)
    add_episode(dataset, filmed[2], filming)
    dataset.finalize()
    item = load(root)[20]
    assert [number_of(item[key].permute(1, 2, 0).numpy() * 255) for key in filming.image_keys] == [20, 41]
