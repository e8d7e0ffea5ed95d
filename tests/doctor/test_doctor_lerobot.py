"""The doctor on what LeRobot's own recorder and tools write, and on what they leave when they are killed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.doctor.examine import examine_folder, repair
from manip_il.doctor.patient import Patient

from ..damage import DATA, EPISODES, cut, edit_json, edit_table, lines
from ..warm import Warm

pytestmark = pytest.mark.slow
HERE = Path(__file__).parent
KINDS = ("state", "video", "image")
MATRIX = "matrix"
Record = Callable[..., None]


@pytest.fixture(scope="module")
def record(warm_lerobot: Warm) -> Record:
    """In a process of its own, which may be killed."""

    def run(root: Path, kind: str, *, episodes: int, end: str = "finalize") -> None:
        done = warm_lerobot.run("python", HERE.parent / "data" / "record_lerobot.py", root, kind, episodes, end)
        assert done.returncode == (0 if end == "finalize" else -9), done.stderr

    return run


@pytest.fixture(scope="module")
def recorded(record: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One dataset a way of storing cameras, with several tasks, texts, and names in a dictionary; one with a matrix."""
    folder = tmp_path_factory.mktemp("theirs")
    for kind in (*KINDS, MATRIX):
        record(folder / kind, kind, episodes=4)
    return folder


def load(root: Path) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("a/b", root=root)


@pytest.mark.parametrize("kind", [*KINDS, MATRIX])
def test_what_lerobot_records_is_clean(recorded, kind):
    assert lines(recorded / kind) == []


@pytest.mark.parametrize("kind", KINDS)
def test_what_lerobots_tools_make_of_it_has_no_errors(recorded, tmp_path, kind):
    from lerobot.datasets import dataset_tools
    from lerobot.datasets.aggregate import aggregate_datasets

    root = recorded / kind
    dataset = load(root)
    dataset_tools.delete_episodes(dataset, [1], output_dir=tmp_path / "deleted", repo_id="a/d")
    dataset_tools.split_dataset(dataset, {"x": [0, 2], "y": [1, 3]}, output_dir=tmp_path / "split")
    aggregate_datasets(["a/b", "a/c"], "a/m", roots=[root, root], aggr_root=tmp_path / "merged")
    for made in ("deleted", "split/x", "split/y", "merged"):
        found = lines(tmp_path / made)
        assert not any(line.startswith("error") for line in found), (made, found)
        assert all("LeRobot's tools do not update them" in line for line in found), (made, found)


@pytest.mark.parametrize("kind", KINDS)
def test_a_recorder_killed_before_finalize_is_named(record, tmp_path, kind):
    record(tmp_path / "dead", kind, episodes=12, end="kill")
    found = lines(tmp_path / "dead")
    first = found[0]
    assert first.startswith("error")
    assert "LeRobot's recorder died here before finalize(): it had saved 12 episodes, 246 frames" in first
    assert f"the rows of 12 episodes are lost, as it never closed {DATA}, {EPISODES}" in first
    assert "LeRobot can neither read nor resume this: record again" in first
    assert ("2 video files remain" in first) == (kind == "video")
    assert ("pictures of episode-000012 that it had not encoded" in first) == (kind != "state")
    for name in (DATA, EPISODES):
        assert any(line.startswith("error") and name in line and "has no footer" in line for line in found)
    assert any("8 pictures that LeRobot's recorder" in line for line in found) == (kind != "state")


def test_a_recorder_killed_before_its_list_of_episodes_was_begun(record, tmp_path):
    record(tmp_path / "dead", "state", episodes=3, end="kill")
    assert "had saved 3 episodes, 48 frames, but the rows of 3 episodes are lost" in lines(tmp_path / "dead")[0]


def test_a_recorder_killed_in_its_first_episode(record, tmp_path):
    record(tmp_path / "dead", "video", episodes=0, end="kill")
    text = "a recorder was started here, but no episode was saved; pictures of episode-000000"
    assert text in lines(tmp_path / "dead")[0]


def test_a_killed_recorder_that_had_resumed_a_whole_dataset(record, recorded, tmp_path):
    """What the advice says makes a dataset of it again."""
    root = shutil.copytree(recorded / "state", tmp_path / "resumed")
    record(root, "state", episodes=11, end="resume")
    first = lines(root)[0]
    assert "the rows of 11 episodes are lost" in first
    assert "the first 4 episodes, 66 frames are intact" in first
    for name in ("data/chunk-000/file-001.parquet", "meta/episodes/chunk-000/file-001.parquet"):
        assert name in first
        (root / name).unlink()
    edit_json(root / layout.INFO, lambda info: info.update(total_episodes=4, total_frames=66, splits={"train": "0:4"}))
    list(repair(Patient(root), examine_folder(root)))
    assert not any(line.startswith("error") for line in lines(root))
    assert load(root).num_frames == 66


def test_a_picture_that_cannot_be_decoded(recorded, tmp_path):
    root = shutil.copytree(recorded / "image", tmp_path / "image")
    key = "observation.images.front"

    def change(table: dict[str, list[Any]]) -> None:
        table[key][5] = {"bytes": table[key][5]["bytes"][:60], "path": None}
        table[key][9] = {"bytes": None, "path": "elsewhere.png"}

    edit_table(root / DATA, change)
    assert any(f"{DATA}: {key}: the picture in row 5 cannot be decoded" in line for line in lines(root))
    edit_json(root / layout.INFO, lambda info: info["features"][key].update(shape=[64, 64, 3]))
    assert any("is 64 x 96 (height x width)" in line and "says 64 x 64" in line for line in lines(root))


def test_a_matrix_is_held_against_its_statistics(recorded, tmp_path):
    """LeRobot has those of a matrix over its last axis."""
    root = shutil.copytree(recorded / MATRIX, tmp_path / MATRIX)
    edit_json(root / layout.STATS, lambda stats: stats["grid"]["mean"].__setitem__(2, 7.0))
    assert any("meta/stats.json: grid: mean[2] is 7; the data's is" in line for line in lines(root))


def test_names_in_a_dictionary_are_counted(recorded, tmp_path):
    root = shutil.copytree(recorded / "state", tmp_path / "state")
    edit_json(root / layout.INFO, lambda info: info["features"]["action"]["names"]["motors"].append("z"))
    assert lines(root) == ["error    meta/info.json: action: 3 names for shape [2]; expected 2"]


def test_statistics_of_a_column_far_from_zero_pass(recorded):
    """LeRobot's standard deviation is a difference of squares in float32: what that costs is no fault."""
    values = np.array(pq.read_table(recorded / MATRIX / DATA)["observation.state"].to_pylist())
    assert np.std(values) < 1e-2 * np.mean(values)
    assert lines(recorded / MATRIX) == []


def test_a_cut_video_of_theirs(recorded, tmp_path):
    root = shutil.copytree(recorded / "video", tmp_path / "video")
    name = "videos/observation.images.wrist/chunk-000/file-000.mp4"
    cut(root / name, 0.6)
    assert any(name in line and "66 rows of 4 episodes" in line for line in lines(root))
