"""LeRobot's unmodified library is the judge of what we write. It imports torch: some seconds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.lerobot_read import dataset_info, read_episodes, read_spec, read_table
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError
from manip_il.mdp import Episode

pytestmark = pytest.mark.slow
REPO = "someone/lift"
DATA = layout.DATA_PATH.format(chunk_index=0, file_index=0)
EPISODES = layout.EPISODES_PATH.format(chunk_index=0, file_index=0)


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory, spec: s.RobotTaskSpec, episodes: list[Episode]) -> Path:
    """The same episodes through LeRobot's own writer."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path_factory.mktemp("theirs") / "dataset"
    dataset = LeRobotDataset.create(
        REPO, fps=spec.fps, features=s.features(spec), root=root, robot_type=spec.robot, use_videos=False
    )
    for episode in episodes:
        add_episode(dataset, episode, spec)
    dataset.finalize()
    return root


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory, spec: s.RobotTaskSpec, episodes: list[Episode]) -> Path:
    root = tmp_path_factory.mktemp("ours") / "dataset"
    write_dataset(episodes, root, spec, repo_id=REPO, fingerprint={})
    return root


def add_episode(dataset: Any, episode: Episode, spec: s.RobotTaskSpec) -> None:
    shapes = {key: feature["shape"] for key, feature in s.features(spec).items()}
    for frame in range(len(episode)):
        row = {key: values[frame].reshape(shapes[key]) for key, values in episode.columns.items()}
        dataset.add_frame(row | {"task": spec.instruction})
    dataset.save_episode()


def load(root: Path, **options: Any) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(REPO, root=root, **options)


def test_the_layout_is_the_librarys(spec: s.RobotTaskSpec) -> None:
    from lerobot.datasets import utils
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
    from lerobot.datasets.feature_utils import get_hf_features_from_features
    from lerobot.utils.constants import DEFAULT_FEATURES

    assert layout.VERSION == CODEBASE_VERSION
    assert (layout.INFO, layout.STATS, layout.TASKS) == (utils.INFO_PATH, utils.STATS_PATH, utils.DEFAULT_TASKS_PATH)
    assert (layout.DATA_PATH, layout.EPISODES_PATH) == (utils.DEFAULT_DATA_PATH, utils.DEFAULT_EPISODES_PATH)
    assert layout.CHUNKS_SIZE == utils.DEFAULT_CHUNK_SIZE
    assert layout.DATA_FILES_SIZE_IN_MB == utils.DEFAULT_DATA_FILE_SIZE_IN_MB
    assert layout.VIDEO_FILES_SIZE_IN_MB == utils.DEFAULT_VIDEO_FILE_SIZE_IN_MB
    assert layout.VIDEO_PATH == utils.DEFAULT_VIDEO_PATH
    assert layout.all_features(spec) == s.features(spec) | DEFAULT_FEATURES
    hugging_face = json.loads(layout.data_schema(spec).metadata[b"huggingface"])["info"]["features"]
    assert hugging_face == get_hf_features_from_features(layout.all_features(spec)).to_dict()


def test_files_and_info_equal_those_of_lerobots_writer(ours: Path, theirs: Path) -> None:
    def names(root: Path) -> set[str]:
        return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}

    assert names(ours) == names(theirs) | {layout.OURS}
    left, right = (json.loads((root / layout.INFO).read_text()) for root in (ours, theirs))
    assert list(left) == list(right)
    assert left == right


@pytest.mark.parametrize("name", [DATA, EPISODES, layout.TASKS])
def test_parquet_schemas_equal_those_of_lerobots_writer(ours: Path, theirs: Path, name: str) -> None:
    left, right = (pq.read_schema(root / name) for root in (ours, theirs))
    assert left.equals(right)


def test_data_equal_those_of_lerobots_writer(ours: Path, theirs: Path) -> None:
    left, right = (pq.ParquetFile(root / DATA) for root in (ours, theirs))
    assert left.read().equals(right.read())
    assert (left.num_row_groups, right.num_row_groups) == (1, 3)  # LeRobot's holds one an episode, ours 1,000 frames
    codec = left.metadata.row_group(0).column(0).compression
    assert codec == right.metadata.row_group(0).column(0).compression


def test_statistics_equal_those_of_lerobots_writer_to_their_precision(
    ours: Path, theirs: Path, episodes: list[Episode]
) -> None:
    left, right = (pq.read_table(root / EPISODES).to_pylist() for root in (ours, theirs))
    for mine, yours in zip(left, right, strict=True):
        assert list(mine) == list(yours)
        for key, value in yours.items():
            if not key.startswith("stats/"):
                assert mine[key] == value, key
                continue
            np.testing.assert_allclose(mine[key], value, rtol=1e-5, atol=2e-3, err_msg=key)
    left, right = (json.loads((root / layout.STATS).read_text()) for root in (ours, theirs))
    assert left.keys() == right.keys()
    for key, table in right.items():
        assert list(left[key]) == list(table)
        for name in ("min", "max", "mean", "std", "count"):
            np.testing.assert_allclose(left[key][name], table[name], rtol=1e-4, atol=1e-3, err_msg=f"{key} {name}")


def test_quantiles_of_a_dataset_are_those_of_all_its_frames(ours: Path, episodes: list[Episode]) -> None:
    stats = json.loads((ours / layout.STATS).read_text())
    actions = np.concatenate([episode.columns[s.ACTION] for episode in episodes]).astype(np.float64)
    for name, share in layout.QUANTILES.items():
        expected = np.quantile(actions, share, axis=0, method="inverted_cdf")
        np.testing.assert_array_equal(stats[s.ACTION][name], expected)


def test_every_frame_that_lerobot_loads_is_the_one_written(
    ours: Path, episodes: list[Episode], spec: s.RobotTaskSpec
) -> None:
    import torch

    dataset = load(ours)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, 20, spec.fps)
    assert dataset.meta.robot_type == spec.robot
    frames = ((number, episode, t) for number, episode in enumerate(episodes) for t in range(len(episode)))
    for index, (number, episode, t) in enumerate(frames):
        item = dataset[index]
        for key, values in episode.columns.items():
            if key == s.SIM_STATE:  # LeRobot makes float32 of a float64 vector; `read_table` does not
                values = values.astype(np.float32)
            assert item[key].dtype == torch.from_numpy(values).dtype, key
            np.testing.assert_array_equal(item[key].numpy(), values[t])
        assert (item["episode_index"], item["frame_index"], item["index"]) == (number, t, index)
        assert item["timestamp"] == pytest.approx(t / spec.fps)
        assert item["task"] == spec.instruction


def test_windows_in_time_stop_at_an_episodes_borders(
    ours: Path, episodes: list[Episode], spec: s.RobotTaskSpec
) -> None:
    step = 1 / spec.fps
    dataset = load(ours, delta_timestamps={s.ACTION: [0, step, 2 * step], s.STATE: [-step, 0]})
    action, state = episodes[0].columns[s.ACTION], episodes[0].columns[s.STATE]
    last = dataset[len(episodes[0]) - 1]
    np.testing.assert_array_equal(last[s.ACTION].numpy(), [action[-1]] * 3)
    assert last["action_is_pad"].tolist() == [False, True, True]
    np.testing.assert_array_equal(last[s.STATE].numpy(), state[-2:])
    first = dataset[0]
    np.testing.assert_array_equal(first[s.ACTION].numpy(), action[:3])
    np.testing.assert_array_equal(first[s.STATE].numpy(), [state[0], state[0]])
    assert first["observation.state_is_pad"].tolist() == [True, False]
    middle = dataset[len(episodes[0])]  # the episode of one frame
    assert middle["action_is_pad"].tolist() == [False, True, True]


def test_a_selection_of_episodes_loads(ours: Path, episodes: list[Episode]) -> None:
    dataset = load(ours, episodes=[2])
    assert dataset.num_frames == 12
    np.testing.assert_array_equal(dataset[0][s.ACTION].numpy(), episodes[2].columns[s.ACTION][0])


def test_many_small_files_load(tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> None:
    root = tmp_path / "small"
    write_dataset(episodes * 4, root, spec, repo_id=REPO, fingerprint={}, data_files_size_in_mb=0.01)
    assert len(list(root.glob(layout.DATA_FILES))) > 1
    dataset = load(root)
    assert [int(dataset[i]["index"]) for i in range(len(dataset))] == list(range(80))
    for number in range(12):
        path = root / dataset.meta.get_data_file_path(number)
        assert number in pq.read_table(path)["episode_index"].to_pylist()


def test_lerobots_tools_delete_split_and_recompute(
    ours: Path, tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec
) -> None:
    from lerobot.datasets import dataset_tools

    kept = dataset_tools.delete_episodes(load(ours), [1], output_dir=tmp_path / "kept", repo_id="someone/kept")
    assert (kept.num_episodes, kept.num_frames) == (2, 19)
    assert_episodes_equal(list(read_episodes(tmp_path / "kept")), [episodes[0], episodes[2]])
    splits = dataset_tools.split_dataset(load(ours), {"train": [0, 2], "rest": [1]}, output_dir=tmp_path / "split")
    assert {name: split.num_frames for name, split in splits.items()} == {"train": 19, "rest": 1}
    recomputed = dataset_tools.recompute_stats(load(tmp_path / "kept"))
    assert recomputed.meta.stats is not None


def test_what_lerobots_tools_leave_still_has_a_spec(ours: Path, tmp_path: Path, spec: s.RobotTaskSpec) -> None:
    from lerobot.datasets import dataset_tools

    dataset_tools.delete_episodes(load(ours), [0], output_dir=tmp_path / "kept", repo_id="someone/kept")
    s.check_same_spec("before", spec, "after", read_spec(tmp_path / "kept"))
    assert read_spec(tmp_path / "kept").instruction == spec.instruction
    assert dataset_info(tmp_path / "kept").success == 1


def test_lerobot_aggregates_ours_with_its_own(
    ours: Path, theirs: Path, tmp_path: Path, episodes: list[Episode]
) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets

    root = tmp_path / "all"
    aggregate_datasets(["a/ours", "a/theirs"], "a/all", roots=[ours, theirs], aggr_root=root)
    assert load(root).num_frames == 40
    assert_episodes_equal(list(read_episodes(root)), episodes * 2)


def test_lerobot_resumes_recording_onto_ours(tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "resumed"
    write_dataset(episodes[:2], root, spec, repo_id=REPO, fingerprint={})
    dataset = LeRobotDataset.resume(REPO, root=root)
    add_episode(dataset, episodes[2], spec)
    dataset.finalize()
    assert load(root).num_frames == 20
    assert_episodes_equal(list(read_episodes(root)), episodes)
    assert dataset_info(root).episodes == 3


def test_lerobots_own_dataset_reads_as_ours(theirs: Path, ours: Path) -> None:
    left, right = read_table(theirs), read_table(ours)
    assert left.keys() == right.keys()
    for key, values in left.items():
        np.testing.assert_array_equal(values, right[key])


def test_a_dataset_that_lerobot_left_unfinished_is_refused(tmp_path: Path, spec: s.RobotTaskSpec) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "unfinished"
    LeRobotDataset.create(REPO, fps=spec.fps, features=s.features(spec), root=root, use_videos=False)
    with pytest.raises(ManipError, match="no data"):
        read_table(root)


def assert_episodes_equal(left: list[Episode], right: list[Episode]) -> None:
    assert [episode.seed for episode in left] == [episode.seed for episode in right]
    for mine, yours in zip(left, right, strict=True):
        assert (mine.success, mine.success_at_end) == (yours.success, yours.success_at_end)
        for key, values in yours.columns.items():
            assert mine.columns[key].dtype == values.dtype, key
            np.testing.assert_array_equal(mine.columns[key], values, err_msg=key)
