"""`lerobot-edit-dataset`, as a user calls it, on datasets that we wrote."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.data.lerobot_read import read_episodes
from manip_il.data.lerobot_write import write_dataset
from manip_il.doctor.examine import examine_folder, has_errors
from manip_il.mdp import Episode

from ..pictures import count_frames, numbered_episodes, numbers_of, video_rows, with_cameras

pytestmark = pytest.mark.slow
REPO = "someone/lift"


@pytest.fixture(params=[(), ("front",)], ids=["state", "camera"])
def recorded(
    request: pytest.FixtureRequest, tmp_path: Path, make_episode: Callable[..., Episode], spec: s.RobotTaskSpec
) -> tuple[Path, list[Episode]]:
    spec = with_cameras(spec, *request.param)
    episodes = numbered_episodes(make_episode, spec, 5)
    write_dataset(episodes, tmp_path / "lift", spec, repo_id=REPO, fingerprint={})
    return tmp_path / "lift", episodes


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
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    for mine, yours in zip(read_episodes(root), episodes, strict=True):
        for key, values in yours.columns.items():
            if key.startswith(s.IMAGES):
                assert numbers_of(mine.columns[key]) == numbers_of(values)
            else:
                np.testing.assert_array_equal(mine.columns[key], values, err_msg=key)
    assert all(count_frames(path) == rows for path, rows in video_rows(root).items())
    assert not has_errors(examine_folder(root))
    dataset = LeRobotDataset(REPO, root=root)
    assert dataset.num_episodes == len(episodes)
    frames = [(episode, t) for episode in episodes for t in range(len(episode))]
    for item, (episode, t) in zip(dataset, frames, strict=True):
        for key, values in episode.columns.items():
            if key.startswith(s.IMAGES):
                seen = item[key].permute(1, 2, 0).numpy() * 255
                assert numbers_of(seen[None]) == numbers_of(values[t : t + 1])
            else:
                np.testing.assert_array_equal(item[key].numpy(), values[t].astype(item[key].numpy().dtype))


def test_episodes_deleted_by_lerobots_command(
    tmp_path: Path, recorded: tuple[Path, list[Episode]], edit: Callable[..., None]
) -> None:
    root, episodes = recorded
    words = ("--operation.type", "delete_episodes", "--operation.episode_indices", "[1, 2]")
    edit("--repo_id", REPO, "--root", str(root), "--new_root", str(tmp_path / "kept"), *words)
    assert_holds(tmp_path / "kept", [episodes[0], *episodes[3:]])


def test_a_dataset_split_and_merged_again_by_lerobots_command(
    tmp_path: Path, recorded: tuple[Path, list[Episode]], edit: Callable[..., None]
) -> None:
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
