"""LeRobot's unmodified library judges what we write, with cameras and without: its writer, its
reader and its tools.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from manip_il.bridges.doctor.examine import examine_folder
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.video_config import VideoConfig
from manip_il.mdp import Episode

from ..damage import DATA, EPISODES
from ..pictures import (
    assert_comes_back,
    count_frames,
    numbered_episodes,
    numbers_of,
    video_rows,
    with_cameras,
    write,
)

pytestmark = pytest.mark.slow
REPO = "someone/lift"
AV1 = VideoConfig("libsvtav1")  # LeRobot's own


@pytest.fixture(scope="module")
def theirs(tmp_path_factory, spec, episodes) -> Path:
    """The same episodes through LeRobot's own writer."""
    return write_by_lerobot(episodes, tmp_path_factory.mktemp("theirs") / "dataset", spec)


@pytest.fixture(scope="module")
def ours(tmp_path_factory, spec, episodes) -> Path:
    return write(episodes, tmp_path_factory.mktemp("ours") / "dataset", spec)


@pytest.fixture(scope="module")
def films(tmp_path_factory, two, filmed) -> tuple[Path, Path]:
    """Ours and theirs with two cameras."""
    folder = tmp_path_factory.mktemp("films")
    return write(filmed, folder / "ours", two, video=AV1), write_by_lerobot(
        filmed, folder / "theirs", two
    )


@pytest.fixture(params=["state", "cameras"])
def pair(request, ours, theirs, films) -> tuple[Path, Path]:
    return (ours, theirs) if request.param == "state" else films


def write_by_lerobot(episodes: list[Episode], root: Path, spec: s.EnvironmentSpec) -> Path:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    options: dict[str, Any] = {
        "features": s.features(spec),
        "robot_type": spec.robot,
        "use_videos": bool(spec.cameras),
    }
    dataset = LeRobotDataset.create(REPO, fps=spec.fps, root=root, **options)
    for episode in episodes:
        add_episode(dataset, episode, spec)
    dataset.finalize()
    return root


def add_episode(dataset: Any, episode: Episode, spec: s.EnvironmentSpec) -> None:
    shapes = {key: feature["shape"] for key, feature in s.features(spec).items()}
    for frame in range(len(episode)):
        row = {key: values[frame].reshape(shapes[key]) for key, values in episode.columns.items()}
        dataset.add_frame(row | {"task": spec.instruction})
    dataset.save_episode()


def load(root: Path, **options: Any) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(REPO, root=root, **options)


def assert_loads(root: Path, episodes: list[Episode]) -> None:
    """LeRobot's reader gives every frame of these episodes, pictures by the number that they
    show.
    """
    import torch

    dataset = load(root)
    assert dataset.num_episodes == len(episodes)
    frames = [
        (number, t, episode) for number, episode in enumerate(episodes) for t in range(len(episode))
    ]
    for index, (item, (number, t, episode)) in enumerate(zip(dataset, frames, strict=True)):
        for key, values in episode.columns.items():
            if key.startswith(s.IMAGES):
                seen = item[key].permute(1, 2, 0).numpy() * 255
                assert numbers_of(seen[None]) == numbers_of(values[t : t + 1])
                continue
            # LeRobot makes float32 of a float64 vector; `read_table` does not
            if key == s.SIM_STATE:
                values = values.astype(np.float32)
            assert item[key].dtype == torch.from_numpy(values).dtype, key
            np.testing.assert_array_equal(item[key].numpy(), values[t])
        assert (item["episode_index"], item["frame_index"], item["index"]) == (number, t, index)
        assert item["timestamp"] == pytest.approx(t / dataset.fps)


def test_files_and_info_equal_those_of_lerobots_writer(pair):
    left, right = (
        {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()} for root in pair
    )
    assert left == right | {layout.OURS}
    left, right = (json.loads((root / layout.INFO).read_text()) for root in pair)
    assert list(left) == list(right)
    assert left == right


@pytest.mark.parametrize("name", [DATA, EPISODES, layout.TASKS])
def test_parquet_schemas_equal_those_of_lerobots_writer(pair, name):
    left, right = (pq.read_schema(root / name) for root in pair)
    ours = [layout.DRAWN] if name == EPISODES else []
    assert [column for column in left.names if column not in right.names] == ours
    assert pa.schema([field for field in left if field.name not in ours]).equals(right)
    if name == DATA:
        ours, theirs = (
            json.loads(one.metadata[b"huggingface"])["info"]["features"] for one in (left, right)
        )
        assert ours == theirs


def test_episodes_and_statistics_equal_those_of_lerobots_writer_to_their_precision(pair):
    left, right = (pq.read_table(root / EPISODES).to_pylist() for root in pair)
    for mine, yours in zip(left, right, strict=True):
        assert mine.pop(layout.DRAWN) == "{}"
        assert list(mine) == list(yours)
        for key, value in yours.items():
            if key.startswith("stats/") or isinstance(value, float):
                np.testing.assert_allclose(mine[key], value, rtol=1e-5, atol=2e-3, err_msg=key)
            else:
                assert mine[key] == value, key
    left, right = (json.loads((root / layout.STATS).read_text()) for root in pair)
    assert left.keys() == right.keys()
    for key, table in right.items():
        assert list(left[key]) == list(table)
        for name in ("min", "max", "mean", "std", "count"):
            if not key.startswith(s.IMAGES):  # LeRobot looks at some of the pixels
                np.testing.assert_allclose(
                    left[key][name], table[name], rtol=1e-4, atol=1e-3, err_msg=f"{key} {name}"
                )


@pytest.mark.parametrize("backend", ["pyav", "torchcodec"])
@pytest.mark.parametrize("file_size", [200.0, 0.001])
def test_lerobot_decodes_the_right_pictures(tmp_path, make_episode, two, backend, file_size):
    episodes = numbered_episodes(make_episode, two, 6)
    root = write(episodes, tmp_path / "film", two, size=file_size)
    assert (len(list(root.rglob("*.mp4"))) > 2) == (file_size < 1)
    step = 1 / two.fps
    dataset = load(
        root, video_backend=backend, delta_timestamps={key: [-step, 0] for key in two.image_keys}
    )
    frames = [(episode, t) for episode in episodes for t in range(len(episode))]
    for item, (episode, t) in zip(dataset, frames, strict=True):
        for key in two.image_keys:
            expected = numbers_of(episode.columns[key][[max(t - 1, 0), t]])
            seen = (item[key].permute(0, 2, 3, 1).numpy() * 255).round()
            assert numbers_of(seen) == expected, (item["index"], key)


@pytest.fixture(params=[(), ("front",)], ids=["state", "camera"])
def seen(request, spec) -> s.EnvironmentSpec:
    return with_cameras(spec, *request.param)


@pytest.fixture
def recorded(tmp_path, make_episode, seen) -> tuple[Path, list[Episode]]:
    episodes = numbered_episodes(make_episode, seen, 5)
    return write(episodes, tmp_path / "lift", seen), episodes


@pytest.fixture
def edit(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """The command in this process: each of its own would import torch again."""
    from lerobot.scripts.lerobot_edit_dataset import main

    def call(*words: str) -> None:
        monkeypatch.setattr(sys, "argv", ["lerobot-edit-dataset", *words])
        main()

    return call


def assert_holds(root: Path, episodes: list[Episode]) -> None:
    """The doctor finds it whole.

    For LeRobot's reader and for ours, numbers are equal and pictures the right ones.
    """
    assert_comes_back(root, episodes)
    assert all(count_frames(path) == rows for path, rows in video_rows(root).items())
    assert not [one for one in examine_folder(root) if one.is_error]
    assert_loads(root, episodes)


def test_episodes_deleted_by_lerobots_command(tmp_path, recorded, edit, seen):
    from lerobot.datasets import dataset_tools

    root, episodes = recorded
    kept = tmp_path / "kept"
    words = ("--operation.type", "delete_episodes", "--operation.episode_indices", "[1, 2]")
    edit("--repo_id", REPO, "--root", str(root), "--new_root", str(kept), *words)
    assert_holds(kept, [episodes[0], *episodes[3:]])
    s.check_same_spec("before", seen, "after", Dataset.open(kept).spec)  # LeRobot drops our file
    assert Dataset.open(kept).spec.keypoints == seen.keypoints
    assert (Dataset.open(kept).spec.instruction, Dataset.open(kept).count_successes()) == (
        seen.instruction,
        3,
    )
    assert dataset_tools.recompute_stats(load(kept)).meta.stats is not None


def test_a_dataset_split_and_merged_again_by_lerobots_command(tmp_path, recorded, edit):
    root, episodes = recorded
    splits = json.dumps({"train": [0, 1, 2], "rest": [3, 4]})
    words = ("--operation.type", "split", "--operation.splits", splits)
    edit("--repo_id", REPO, "--root", str(root), "--new_root", str(tmp_path / "split"), *words)
    parts = [tmp_path / "split" / name for name in ("train", "rest")]
    assert_holds(parts[0], episodes[:3])
    assert_holds(parts[1], episodes[3:])
    words = (
        "--operation.repo_ids",
        "['a/train', 'a/rest']",
        "--operation.roots",
        str([str(part) for part in parts]),
    )
    new = ("--new_repo_id", "a/all", "--new_root", str(tmp_path / "all"))
    edit(*new, "--operation.type", "merge", *words)
    assert_holds(tmp_path / "all", episodes)


def test_lerobot_records_on_into_ours(tmp_path, recorded, seen):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    _, episodes = recorded
    root = write(episodes[:2], tmp_path / "resumed", seen)
    dataset = LeRobotDataset.resume(REPO, root=root)
    add_episode(dataset, episodes[2], seen)
    dataset.finalize()
    assert_holds(root, episodes[:3])
    assert Dataset.open(root).info.episodes == 3
