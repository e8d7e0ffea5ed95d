"""LeRobot's tools on datasets that we wrote: its command to edit them, joining, and recording on."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.data.lerobot_read import dataset_info, read_spec
from manip_il.doctor.examine import examine_folder, has_errors
from manip_il.mdp import Episode

from ..pictures import assert_comes_back, count_frames, numbered_episodes, numbers_of, video_rows, with_cameras, write
from .test_lerobot_library import REPO, add_episode, load, write_by_lerobot

pytestmark = pytest.mark.slow


@pytest.fixture(params=[(), ("front",)], ids=["state", "camera"])
def seen(request, spec) -> s.RobotTaskSpec:
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
    """The doctor finds it whole; for LeRobot's reader and for ours, numbers are equal and pictures the right ones."""
    assert_comes_back(root, episodes)
    assert all(count_frames(path) == rows for path, rows in video_rows(root).items())
    assert not has_errors(examine_folder(root))
    dataset = load(root)
    assert dataset.num_episodes == len(episodes)
    frames = [(episode, t) for episode in episodes for t in range(len(episode))]
    for item, (episode, t) in zip(dataset, frames, strict=True):
        for key, values in episode.columns.items():
            if key.startswith(s.IMAGES):
                seen = item[key].permute(1, 2, 0).numpy() * 255
                assert numbers_of(seen[None]) == numbers_of(values[t : t + 1])
            else:
                np.testing.assert_array_equal(item[key].numpy(), values[t].astype(item[key].numpy().dtype))


def test_episodes_deleted_by_lerobots_command(tmp_path, recorded, edit, seen):
    from lerobot.datasets import dataset_tools

    root, episodes = recorded
    kept = tmp_path / "kept"
    words = ("--operation.type", "delete_episodes", "--operation.episode_indices", "[1, 2]")
    edit("--repo_id", REPO, "--root", str(root), "--new_root", str(kept), *words)
    assert_holds(kept, [episodes[0], *episodes[3:]])
    s.check_same_spec("before", seen, "after", read_spec(kept))  # LeRobot drops our file
    assert (read_spec(kept).instruction, dataset_info(kept).success) == (seen.instruction, 3)
    assert dataset_tools.recompute_stats(load(kept)).meta.stats is not None


def test_a_dataset_split_and_merged_again_by_lerobots_command(tmp_path, recorded, edit):
    root, episodes = recorded
    splits = json.dumps({"train": [0, 1, 2], "rest": [3, 4]})
    words = ("--operation.type", "split", "--operation.splits", splits)
    edit("--repo_id", REPO, "--root", str(root), "--new_root", str(tmp_path / "split"), *words)
    parts = [tmp_path / "split" / name for name in ("train", "rest")]
    assert_holds(parts[0], episodes[:3])
    assert_holds(parts[1], episodes[3:])
    words = ("--operation.repo_ids", "['a/train', 'a/rest']", "--operation.roots", str([str(part) for part in parts]))
    new = ("--new_repo_id", "a/all", "--new_root", str(tmp_path / "all"))
    edit(*new, "--operation.type", "merge", *words)
    assert_holds(tmp_path / "all", episodes)


def test_lerobot_joins_ours_with_its_own(tmp_path, episodes, spec):
    from lerobot.datasets.aggregate import aggregate_datasets

    roots = [write(episodes, tmp_path / "ours", spec), write_by_lerobot(episodes, tmp_path / "theirs", spec)]
    aggregate_datasets(["a/ours", "a/theirs"], "a/all", roots=roots, aggr_root=tmp_path / "all")
    assert_holds(tmp_path / "all", episodes * 2)


def test_lerobot_records_on_into_ours(tmp_path, recorded, seen):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    _, episodes = recorded
    root = write(episodes[:2], tmp_path / "resumed", seen)
    dataset = LeRobotDataset.resume(REPO, root=root)
    add_episode(dataset, episodes[2], seen)
    dataset.finalize()
    assert_holds(root, episodes[:3])
    assert dataset_info(root).episodes == 3
