"""Out to MCAP and in again: equal numbers, equal pictures, whoever wrote the dataset."""

import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.bridges.mcap.export import MAPPING, export_dataset, left_out
from manip_il.bridges.mcap.importing import import_files, list_files
from manip_il.bridges.mcap.mapping import load_mapping
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import NotFiniteError
from manip_il.mdp import Episode

from ..damage import DATA, edit_json, edit_table
from .use import decoded

# As another program's dataset may have them.
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": {"motors": ["a", "b", "c"]}},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "count": {"dtype": "int64", "shape": (1,), "names": None},
    "bytes": {"dtype": "uint8", "shape": (2,), "names": ["same", "same"]},
    "flag": {"dtype": "bool", "shape": (1,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
    "matrix": {"dtype": "float64", "shape": (2, 3), "names": None},
    "observation.images.top": {
        "dtype": "image",
        "shape": (8, 12, 3),
        "names": ["height", "width", "channels"],
    },
    "observation.images.side": {
        "dtype": "video",
        "shape": (64, 64, 3),
        "names": ["height", "width", "channels"],
    },
}


@pytest.fixture(scope="module")
def ours(
    tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode], spec: s.EnvironmentSpec
) -> Path:
    root = tmp_path_factory.mktemp("ours") / "d"
    write_dataset(episodes, root, spec, fingerprint={})
    return root


def lerobots(
    root: Path, fps: float, features: dict[str, Any], frames: list[list[dict[str, Any]]]
) -> Path:
    """A dataset of LeRobot's own, an episode a list of frames."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset.create("local/d", fps, features, root=root, robot_type=None)
    for episode in frames:
        for frame in episode:
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def frame_of(rng: np.random.Generator, number: int) -> dict[str, Any]:
    return {
        "observation.state": rng.normal(size=3).astype(np.float32),
        "action": (rng.normal(size=2) * 1e-30).astype(np.float32),
        "count": np.array([2**63 - 1 - number]),
        "bytes": rng.integers(0, 256, 2, np.uint8),
        "flag": np.array([number % 2 == 0]),
        "note": f"é\n{number}",
        "matrix": rng.normal(size=(2, 3)),
        "observation.images.top": rng.integers(0, 256, (8, 12, 3), np.uint8),
        "observation.images.side": np.full((64, 64, 3), 30 * number, np.uint8),
        "task": "wipe" if number < 2 else "fold, 100 %",
    }


def export(root: Path, folder: Path) -> list[Path]:
    folder.mkdir()
    return list(export_dataset(Dataset.open(root), folder))


def by_topic(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for topic, _, message in decoded(path.read_bytes()):
        found.setdefault(topic, []).append(message)
    return found


def test_an_export_read_by_others_holds_the_datasets_values(ours: Path, tmp_path: Path) -> None:
    paths = export(ours, tmp_path / "out")
    assert [path.name for path in paths] == [f"episode_{number:06d}.mcap" for number in range(3)]
    table, start = Dataset.open(ours).columns(), 0
    for path in paths:
        found = by_topic(path)
        rows = slice(start, start := start + len(found["/task"]))
        states = [
            [joint.position for joint in message.joints] for message in found["/observation/state"]
        ]
        assert states == table[s.STATE][rows].tolist()
        assert [joint.name for joint in found["/action"][0].joints] == [
            "shoulder",
            "elbow",
            "gripper",
        ]
        for key, topic in (
            (s.SIM_STATE, "/sim_state"),
            (s.SEED, "/seed"),
            (s.REWARD, "/next/reward"),
        ):
            values = [
                [scalar["value"] for scalar in message["scalars"]] for message in found[topic]
            ]
            assert np.ravel(values).tolist() == table[key][rows].ravel().tolist()
        labels = [scalar["label"] for scalar in found["/sim_state"][0]["scalars"]]
        assert labels == [f"sim_state_{place}" for place in range(7)]  # as LeRobot labels them
    assert start == len(table[s.SEED])
    again = export(ours, tmp_path / "again")
    assert [path.read_bytes() for path in paths] == [path.read_bytes() for path in again]


def test_a_number_that_is_not_finite_is_refused_and_a_column_without_a_place_left_out(
    ours: Path, tmp_path: Path
):
    root = shutil.copytree(ours, tmp_path / "d")
    odd = {
        "text": {"dtype": "language"},
        "depth": {"dtype": "image", "info": {"is_depth_map": True}},
    }
    odd = {key: {"shape": [4, 4, 3], "names": None, **one} for key, one in odd.items()}
    edit_json(root / layout.INFO, lambda info: info["features"].update(odd))
    assert left_out(Dataset.open(root).info) == ["text", "depth"]
    assert not {"/text", "/depth"} & by_topic(export(root, tmp_path / "rest")[1]).keys()
    edit_table(root / DATA, lambda columns: columns.update({s.REWARD: [0.0, np.nan, *[1.0] * 18]}))
    with pytest.raises(NotFiniteError, match=r"column 'next\.reward': nan at index 1"):
        export(root, tmp_path / "out")


@pytest.mark.slow
def test_a_fractional_rate_comes_back_with_its_exact_times(tmp_path: Path) -> None:
    fps = 30_000 / 1001
    frames = [{"action": np.full(2, number, np.float32), "task": "wipe"} for number in range(900)]
    root = lerobots(tmp_path / "d", fps, {"action": FEATURES["action"]}, [frames])
    [path] = export(root, tmp_path / "out")
    assert decoded(path.read_bytes())[-1][1] == 899 * 10**9 // Fraction(fps).limit_denominator(1001)
    assert (
        import_files([path], tmp_path / "new", load_mapping(tmp_path / "out" / MAPPING)).frames
        == 900
    )
    left, right = Dataset.open(root), Dataset.open(tmp_path / "new")
    assert right.fps == fps
    for key in ("action", "timestamp"):
        assert right.columns([key])[key].tobytes() == left.columns([key])[key].tobytes()


@pytest.mark.slow
def test_lerobots_comes_back_with_its_tasks_odd_columns_and_pictures(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [[frame_of(rng, number) for number in range(length)] for length in (4, 5)]
    root = lerobots(tmp_path / "d", 30, FEATURES, frames)
    export(root, tmp_path / "out")
    mapping = load_mapping(tmp_path / "out" / MAPPING)
    assert import_files(list_files(tmp_path / "out"), tmp_path / "new", mapping).frames == 9
    left, right = Dataset.open(root), Dataset.open(tmp_path / "new")
    assert (right.fps, right.info.robot) == (30, "")
    texts = [
        [one.tasks[i] for i in one.columns(["task_index"])["task_index"].tolist()]
        for one in (left, right)
    ]
    assert (
        texts[0]
        == texts[1]
        == 2 * ["wipe"] + 2 * ["fold, 100 %"] + 2 * ["wipe"] + 3 * ["fold, 100 %"]
    )
    names = [key for key in left.features if key not in (*left.cameras, "task_index")]
    for key, values in left.columns(names).items():
        new = right.columns(names)[key]
        assert (new.dtype, new.tolist(), right.features[key]) == (
            values.dtype,
            values.tolist(),
            left.features[key],
        )
    for key in left.cameras:
        np.testing.assert_array_equal(
            right.frames(key, np.arange(9)), left.frames(key, np.arange(9))
        )
