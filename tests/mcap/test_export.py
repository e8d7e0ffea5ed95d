"""Out to MCAP and in again: equal numbers, equal pictures, whoever wrote the dataset."""

from __future__ import annotations

import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.info import INDEX_FEATURES
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError, NotFiniteError
from manip_il.mcap.export import MAPPING, export_dataset, left_out
from manip_il.mcap.importing import import_files, list_files
from manip_il.mcap.mapping import load_mapping
from manip_il.mdp import Episode

from ..damage import DATA, edit_json, edit_table
from ..synthetic import MakeEpisode
from .use import decoded

# As another program's dataset may have them.
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": {"motors": ["a", "b", "c"]}},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "count": {"dtype": "int64", "shape": (1,), "names": None},
    "bytes": {"dtype": "uint8", "shape": (2,), "names": ["same", "same"]},
    "byte": {"dtype": "uint8", "shape": (1,), "names": ["same", "same"]},
    "flag": {"dtype": "bool", "shape": (1,), "names": None},
    "fine": {"dtype": "float64", "shape": (4,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
    "matrix": {"dtype": "float32", "shape": (2, 3), "names": None},
    "observation.images.top": {"dtype": "image", "shape": (8, 12, 3), "names": ["height", "width", "channels"]},
    "observation.images.side": {"dtype": "video", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
}


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    root = tmp_path_factory.mktemp("ours") / "d"
    write_dataset(episodes, root, spec, repo_id="local/d", fingerprint={})
    return root


@pytest.fixture(scope="module")
def lerobots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Several tasks within an episode, odd features, both kinds of camera, no robot; two episodes of 4 and 5 frames."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path_factory.mktemp("lerobots") / "d"
    dataset = LeRobotDataset.create("local/d", 30, FEATURES, root=root, robot_type=None)
    rng = np.random.default_rng(0)
    for length in (4, 5):
        for frame in range(length):
            dataset.add_frame(lerobot_frame(rng, frame))
        dataset.save_episode()
    dataset.finalize()
    return root


def lerobot_frame(rng: np.random.Generator, frame: int) -> dict[str, Any]:
    return {
        "observation.state": rng.normal(size=3).astype(np.float32),
        "action": (rng.normal(size=2) * 1e-30).astype(np.float32),
        "count": np.array([2**63 - 1 - frame]),
        "bytes": rng.integers(0, 256, 2, np.uint8),
        "byte": rng.integers(0, 256, 1, np.uint8),
        "flag": np.array([frame % 2 == 0]),
        "fine": rng.normal(size=4),
        "note": f"é\n{frame}",
        "matrix": rng.normal(size=(2, 3)).astype(np.float32),
        "observation.images.top": rng.integers(0, 256, (8, 12, 3), np.uint8),
        "observation.images.side": np.full((64, 64, 3), 30 * frame, np.uint8),
        "task": "wipe" if frame < 2 else "fold, 100 %",
    }


def export(root: Path, folder: Path) -> list[Path]:
    folder.mkdir()
    return list(export_dataset(Dataset.open(root), folder))


def test_an_export_read_by_mcap_holds_the_datasets_values(ours: Path, tmp_path: Path) -> None:
    paths = export(ours, tmp_path / "out")
    assert [path.name for path in paths] == [f"episode_{number:06d}.mcap" for number in range(3)]
    table = Dataset.open(ours).columns()
    start = 0
    for path in paths:
        found: dict[str, list[Any]] = {}
        for topic, _, message in decoded(path.read_bytes()):
            found.setdefault(topic, []).append(message)
        stop = start + len(found["/task"])
        states = [[joint.position for joint in message.joints] for message in found["/observation/state"]]
        assert states == table[s.STATE][start:stop].tolist()
        assert [joint.name for joint in found["/action"][0].joints] == ["shoulder", "elbow", "gripper"]
        for key, topic in ((s.SIM_STATE, "/sim_state"), (s.SEED, "/seed"), (s.REWARD, "/next/reward")):
            values = [[scalar["value"] for scalar in message["scalars"]] for message in found[topic]]
            assert values == table[key][start:stop].reshape(stop - start, -1).tolist()
        labels = [scalar["label"] for scalar in found["/sim_state"][0]["scalars"]]
        assert labels == [f"sim_state.{number}" for number in range(7)]
        start = stop
    assert start == len(table[s.SEED])


def test_an_exports_metadata_says_what_the_dataset_was(ours: Path, tmp_path: Path) -> None:
    path = export(ours, tmp_path / "out")[2]
    with path.open("rb") as stream:
        (record,) = make_reader(stream).iter_metadata()
    info = (ours / layout.INFO).read_text()
    assert (record.name, record.metadata) == ("lerobot", {"info": info, "episode_index": "2"})


def test_the_same_dataset_gives_the_same_bytes(ours: Path, tmp_path: Path) -> None:
    first, second = export(ours, tmp_path / "a"), export(ours, tmp_path / "b")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_a_number_that_is_not_finite_is_refused_by_name(
    make_episode: MakeEpisode, spec: s.RobotTaskSpec, tmp_path: Path
) -> None:
    root = tmp_path / "d"
    write_dataset([make_episode(1, 4)], root, spec, repo_id="local/d", fingerprint={})
    edit_table(root / DATA, lambda columns: columns.update({s.REWARD: [0.0, 1.0, np.nan, 1.0]}))
    with pytest.raises(NotFiniteError, match=r"column 'next\.reward': nan at index 2"):
        export(root, tmp_path / "out")


@pytest.mark.parametrize("change", [{"dtype": "language"}, {"dtype": "image", "info": {"is_depth_map": True}}])
def test_a_column_without_a_place_in_mcap_is_left_out_and_named(
    ours: Path, tmp_path: Path, change: dict[str, Any]
) -> None:
    root = shutil.copytree(ours, tmp_path / "d")
    edit_json(
        root / layout.INFO, lambda info: info["features"].update(odd={"shape": [4, 4, 1], "names": None, **change})
    )
    assert left_out(Dataset.open(root).info) == ["odd"]
    assert {topic for topic, *_ in decoded(export(root, tmp_path / "out")[1].read_bytes())} == {
        topic for topic, *_ in decoded(export(ours, tmp_path / "whole")[1].read_bytes())
    }


def test_tasks_without_the_indexs_name_are_exported(ours: Path, tmp_path: Path) -> None:
    root = shutil.copytree(ours, tmp_path / "d")
    pd.DataFrame({"task_index": [0]}, index=["Lift the cube, 100 %."]).to_parquet(root / layout.TASKS)
    texts = {
        message.message
        for topic, _, message in decoded(export(root, tmp_path / "out")[0].read_bytes())
        if topic == "/task"
    }
    assert texts == {"Lift the cube, 100 %."}


@pytest.mark.slow
def test_ours_comes_back_as_an_equal_dataset(ours: Path, tmp_path: Path) -> None:
    export(ours, tmp_path / "out")
    mapping = load_mapping(tmp_path / "out" / MAPPING)
    assert list(import_files(list_files(tmp_path / "out"), tmp_path / "new", mapping)) == [7, 1, 12]
    left, right = Dataset.open(ours), Dataset.open(tmp_path / "new")
    for key, values in left.columns().items():
        new = right.columns()[key]
        assert (new.dtype, new.tobytes()) == (values.dtype, values.tobytes()), key
    assert (right.instruction, right.features) == (left.instruction, left.features)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "out"]


@pytest.mark.slow
@pytest.mark.parametrize("fps", [29.97, 30_000 / 1001])
def test_a_fractional_rate_comes_back_with_its_exact_times(tmp_path: Path, fps: float) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {"action": FEATURES["action"]}
    dataset = LeRobotDataset.create("local/d", fps, features, root=tmp_path / "d", robot_type=None)
    for frame in range(900):
        dataset.add_frame({"action": np.full(2, frame, np.float32), "task": "wipe"})
    dataset.save_episode()
    dataset.finalize()
    (path,) = export(tmp_path / "d", tmp_path / "out")
    last = max(time for _, time, _ in decoded(path.read_bytes()))
    assert last == 899 * 10**9 // Fraction(fps).limit_denominator(1001)
    mapping = load_mapping(tmp_path / "out" / MAPPING)
    assert list(import_files([path], tmp_path / "new", mapping)) == [900]
    left, right = Dataset.open(tmp_path / "d"), Dataset.open(tmp_path / "new")
    assert right.fps == fps
    for key in ("action", "timestamp"):
        assert right.columns([key])[key].tobytes() == left.columns([key])[key].tobytes()


@pytest.mark.slow
def test_lerobots_comes_back_with_its_tasks_odd_columns_and_pictures(lerobots: Path, tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    export(lerobots, tmp_path / "out")
    mapping = load_mapping(tmp_path / "out" / MAPPING)
    assert list(import_files(list_files(tmp_path / "out"), tmp_path / "new", mapping)) == [4, 5]
    left, right = (LeRobotDataset("local/d", root=root) for root in (lerobots, tmp_path / "new"))
    assert (len(right), right.num_episodes, right.fps, right.meta.robot_type) == (9, 2, 30, None)
    assert {*left.features} == {*right.features}
    rng = np.random.default_rng(0)
    for mine, theirs, frame in zip(right, left, (*range(4), *range(5)), strict=True):
        for key in (*FEATURES, "task", *INDEX_FEATURES[:-1]):
            assert np.array_equal(np.asarray(mine[key]), np.asarray(theirs[key])), key
        recorded = lerobot_frame(rng, frame)["observation.images.top"]
        assert np.array_equal(np.round(np.moveaxis(mine["observation.images.top"].numpy(), 0, 2) * 255), recorded)


@pytest.mark.slow
def test_an_import_that_fails_leaves_nothing(ours: Path, tmp_path: Path) -> None:
    paths = export(ours, tmp_path / "out")
    paths[2].write_bytes(paths[2].read_bytes()[:1000])
    mapping = load_mapping(tmp_path / "out" / MAPPING)
    with pytest.raises(ManipError, match=r"cannot read .*episode_000002\.mcap: "):
        list(import_files(paths, tmp_path / "new", mapping))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
