"""Datasets as other people have them: each is opened, has no errors, and is trained on from its
pictures.
"""

import json
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from manip_il.bridges.doctor.examine import examine_folder
from manip_il.cli.main import main
from manip_il.data import lerobot_layout as layout
from manip_il.data.build import merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.errors import MismatchError
from manip_il.learn.policy import LearnedPolicy

from ..damage import DATA, EPISODES, edit_json, edit_table
from ..learn.tiny_policies import ACT, DIFFUSION

pytestmark = pytest.mark.slow
TOP, SIDE, DEPTH = "observation.images.top", "observation.image", "observation.images.depth"
FRONT = "observation.images.front"
MOTORS = {"motors": ["shoulder_pan.pos", "elbow.pos", "gripper"]}
NAMES = ["height", "width", "channels"]
SIZE = (32, 48)


def record(root: Path, tasks: list[str], **more: dict[str, Any]) -> Path:
    """Three episodes by LeRobot's own writer, with pictures in videos of several episodes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    table: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": (3,), "names": MOTORS},
        "action": {"dtype": "float32", "shape": (3,), "names": None},
        TOP: {"dtype": "video", "shape": (*SIZE, 3), "names": NAMES},
        **more,
    }
    dataset: Any = LeRobotDataset.create("a/b", 30, table, root=root)
    rng = np.random.default_rng(0)
    for episode, task in enumerate(tasks):
        for _ in range(12 + episode):
            frame: dict[str, Any] = {"task": task}
            for key, feature in table.items():
                if feature["dtype"] == "float32":
                    frame[key] = rng.normal(size=feature["shape"]).astype(np.float32)
                elif feature["shape"][-1] == 3:
                    frame[key] = rng.integers(0, 256, feature["shape"], np.uint8)
                else:
                    frame[key] = rng.integers(100, 2000, feature["shape"]).astype(np.uint16)
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def check(root: Path, folder: Path) -> str:
    """Open, examine and train; return what the spec calls the joints."""
    dataset = Dataset.open(root)
    assert dataset.episodes.length.sum() == len(dataset)
    assert len(dataset.columns()["action"]) == len(dataset) == dataset.info.frames
    assert [str(one) for one in examine_folder(root) if one.place != layout.STATS] == []
    policy = [
        f"--policy.{name}={value}"
        for name, value in (ACT | {"chunk_size": 4, "n_action_steps": 2}).items()
    ]
    words = [
        *policy,
        "--policy.pretrained_backbone_weights=null",
        "--observation=images",
        "--batch_size=4",
    ]
    told = ["train", f"--dataset.root={root}", *words, "--steps=2", f"--output_dir={folder}"]
    assert main(told) == 0
    assert (folder / "checkpoints/last/pretrained_model/model.safetensors").is_file()
    return " ".join(dataset.spec.joint_names)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("theirs") / "plain", ["fold", "unfold", "fold"])


@pytest.fixture
def root(recorded: Path, tmp_path: Path) -> Path:
    return shutil.copytree(recorded, tmp_path / "plain")


def names_of_joints(names: Any) -> Callable[[Path], None]:
    return lambda root: edit_json(
        root / layout.INFO, lambda info: info["features"]["action"].update(names=names)
    )


def tasks_without_a_named_index(root: Path) -> None:
    texts = pa.array(["fold", "unfold"])
    table = pa.table({"task_index": pa.array([0, 1], pa.int64()), "__index_level_0__": texts})
    pq.write_table(table, root / layout.TASKS)


def language(root: Path) -> None:
    """The columns that LeRobot's annotations add."""
    from lerobot.datasets import language as theirs

    table = pq.read_table(root / DATA)
    said = {"role": "user", "content": "fold it", "style": "plan", "timestamp": 0.0}
    fields = list(theirs.language_persistent_row_arrow_type())
    columns = [
        pa.array([said.get(one.name)] * len(table), one.type)
        for one in fields
        if one.name != "tool_calls"
    ]
    rows = pa.StructArray.from_arrays(
        [*columns, pa.nulls(len(table), fields[-1].type)], fields=fields
    )
    column = pa.ListArray.from_arrays(np.arange(len(table) + 1, dtype=np.int32), rows)
    pq.write_table(table.append_column(theirs.LANGUAGE_PERSISTENT, column), root / DATA)
    feature = {"dtype": "language", "shape": [1], "names": None}
    edit_json(
        root / layout.INFO,
        lambda info: info["features"].update({theirs.LANGUAGE_PERSISTENT: feature}),
    )


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (names_of_joints(None), "action.0 action.1 action.2"),
        (tasks_without_a_named_index, "action.0 action.1 action.2"),
        (language, "action.0 action.1 action.2"),
    ],
)
def test_a_dataset_that_is_written_another_way(root, tmp_path, change, names):
    change(root)
    assert check(root, tmp_path / "run") == names


def test_empty_tasks_and_tasks_of_many_lines(tmp_path):
    root = record(tmp_path / "tasks", ["", "fold the\ntowel\n", "fold"])
    assert list(Dataset.open(root).tasks.values()) == ["", "fold the\ntowel\n", "fold"]
    check(root, tmp_path / "run")


def test_a_rate_that_is_no_whole_number(root, tmp_path):
    rate, columns = (
        Fraction(2997, 100),
        ("timestamp", f"videos/{TOP}/from_timestamp", f"videos/{TOP}/to_timestamp"),
    )
    [video] = root.glob("videos/**/*.mp4")
    pictures = Dataset.open(root).camera(TOP).rows(np.arange(39))
    with av.open(video, "w") as container:
        stream: Any = container.add_stream("h264", rate=rate)
        stream.height, stream.width = SIZE
        for one in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(one, format="rgb24")))
        container.mux(stream.encode(None))

    def slow_down(rows: dict[str, list[Any]]) -> None:
        rows.update(
            {
                name: [float(30 / rate) * one for one in rows[name]]
                for name in columns
                if name in rows
            }
        )

    edit_table(root / DATA, slow_down)
    edit_table(root / EPISODES, slow_down)
    edit_json(root / layout.INFO, lambda info: info.update(fps=29.97))
    edit_json(root / layout.STATS, lambda stats: stats.pop("timestamp"))
    assert Dataset.open(root).fps == 29.97
    assert (
        np.abs(Dataset.open(root).camera(TOP).rows(np.arange(39)).astype(int) - pictures).mean()
        < 40
    )
    check(root, tmp_path / "run")


def test_pictures_of_two_sizes_and_kinds_one_not_called_a_camera(tmp_path):
    more = {SIDE: {"dtype": "image", "shape": (24, 24, 3), "names": NAMES}}
    root = record(tmp_path / "sizes", ["fold"] * 3, **more)
    check(root, tmp_path / "run")
    config = json.loads(
        (tmp_path / "run/checkpoints/last/pretrained_model/config.json").read_text()
    )
    assert {TOP, SIDE} < set(config["input_features"])


def test_depth_is_left_out(tmp_path):
    depth = {"dtype": "video", "shape": (*SIZE, 1), "names": NAMES, "info": {"is_depth_map": True}}
    root = record(tmp_path / "depth", ["fold"] * 3, **{DEPTH: depth})
    check(root, tmp_path / "run")
    config = json.loads(
        (tmp_path / "run/checkpoints/last/pretrained_model/config.json").read_text()
    )
    assert set(config["input_features"]) == {"observation.state", TOP}


@pytest.mark.parametrize(
    "settings", [{"type": "mlp"}, ACT, DIFFUSION], ids=lambda settings: settings["type"]
)
def test_joints_alone_of_any_robot_train_a_policy_that_lerobot_loads(tmp_path, settings):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = {"dtype": "float32", "shape": (3,), "names": MOTORS}
    columns = {"observation.state": names, "action": names}
    dataset: Any = LeRobotDataset.create(
        "a/b", 30, columns, root=tmp_path / "joints", robot_type="my arm/v2.yaml"
    )
    for state in np.random.default_rng(0).normal(size=(3, 12, 3)).astype(np.float32):
        for row in state:
            dataset.add_frame({"observation.state": row, "action": 0.9 * row, "task": "fold"})
        dataset.save_episode()
    dataset.finalize()
    policy = [
        f"--policy.{name}={json.dumps(value).strip(chr(34))}" for name, value in settings.items()
    ]
    words = [
        f"--dataset.root={tmp_path / 'joints'}",
        "--steps=2",
        "--batch_size=4",
        f"--output_dir={tmp_path / 'run'}",
    ]
    assert main(["train", *policy, *words]) == 0
    assert Dataset.open(tmp_path / "joints").info.robot == "my arm/v2.yaml"
    folder = tmp_path / "run/checkpoints/last/pretrained_model"
    ours = LearnedPolicy.load(folder)
    assert ours.checkpoint.numbers == {"observation.state": 3}
    assert ours.checkpoint.origin.robot == "my_arm_v2_yaml"
    state = np.ones((1, 3), np.float32)
    theirs: Any = get_policy_class(settings["type"]).from_pretrained(folder)
    before, after = make_pre_post_processors(theirs.config, str(folder))
    torch.manual_seed(0)
    action = after(theirs.select_action(before({"observation.state": torch.from_numpy(state)})))
    acted = ours.act(state, np.empty((1, 0), np.float32))
    assert acted.shape == action.shape == (1, 3)
    assert settings is DIFFUSION or acted == pytest.approx(action.numpy(), abs=1e-5)  # which draws


def test_an_mlp_reads_what_is_there_beside_pictures(root, tmp_path):
    assert (
        main(["train", f"--dataset.root={root}", "--steps=2", f"--output_dir={tmp_path / 'run'}"])
        == 0
    )
    assert LearnedPolicy.load(
        tmp_path / "run/checkpoints/last/pretrained_model"
    ).checkpoint.numbers == {"observation.state": 3}


@pytest.fixture(scope="module")
def annotated(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two datasets with depth and LeRobot's columns of language."""
    depth = {"dtype": "video", "shape": (*SIZE, 1), "names": NAMES, "info": {"is_depth_map": True}}
    folder = tmp_path_factory.mktemp("annotated")
    roots = [
        record(folder / name, tasks, **{DEPTH: depth})
        for name, tasks in (("a", ["fold"] * 3), ("b", ["un"] * 2))
    ]
    for root in roots:
        language(root)
    return roots


def items(root: Path) -> list[dict[str, Any]]:
    """What LeRobot's own loader returns, without the numbers of rows, episodes and texts."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    numbers = {"index", "episode_index", "task_index"}
    dataset: Any = LeRobotDataset("a/b", root=root)
    found = [
        {key: value for key, value in one.items() if key not in numbers}
        for one in map(dict, dataset)
    ]
    return [
        {key: getattr(value, "tolist", lambda value=value: value)() for key, value in one.items()}
        for one in found
    ]


def test_merged_datasets_of_others_are_for_lerobot_those_of_their_frames(annotated, tmp_path):
    assert main(["data", "merge", *map(str, annotated), f"--output={tmp_path / 'both'}"]) == 0
    assert items(tmp_path / "both") == [one for root in annotated for one in items(root)]
    assert examine_folder(tmp_path / "both") == []
    assert not (tmp_path / "both" / layout.OURS).exists()
    features = json.loads((annotated[0] / layout.INFO).read_text())["features"]
    assert json.loads((tmp_path / "both" / layout.INFO).read_text())["features"] == features


def test_chosen_episodes_are_taken_with_their_films(annotated, tmp_path):
    words = [
        "data",
        "merge",
        *map(str, annotated),
        "--dataset.episodes=[1,3:5]",
        f"--output={tmp_path / 'part'}",
    ]
    assert main(words) == 0
    first, second = map(items, annotated)
    assert items(tmp_path / "part") == first[12:25] + second
    assert examine_folder(tmp_path / "part") == []
    assert (
        main(
            [
                "data",
                "merge",
                str(annotated[0]),
                "--dataset.episodes=2:9",
                f"--output={tmp_path / 'no'}",
            ]
        )
        == 2
    )


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda info: info.update(fps=29.97), "fps differs: .*/plain has 29.97, .*/plain has 30.0"),
        (lambda info: info["features"].pop("action"), "column action differs: .*/plain has none"),
        (
            lambda info: info["features"][TOP]["info"].update({"video.codec": "h264"}),
            f"film {TOP}: video.codec differs",
        ),
        (
            lambda info: info["features"][TOP].update(shape=[24, 32, 3]),
            f"column {TOP} differs: .*24, 32, 3",
        ),
        (
            lambda info: info.update(robot_type="koch"),
            "robot_type differs: .*/plain has koch, .*/plain has none",
        ),
    ],
)
def test_what_a_merge_cannot_keep_is_refused_by_name(root, recorded, tmp_path, change, what):
    edit_json(root / layout.INFO, change)
    with pytest.raises(MismatchError, match=what):
        merge_datasets([root, recorded], tmp_path / "both")
    assert not (tmp_path / "both").exists()
