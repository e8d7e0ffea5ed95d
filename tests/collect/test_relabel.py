"""A relabelled dataset has the labels that the expert of today gives its states, and is the same in all else."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.cli.main import main
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.relabel import Changes, label_states, relabel_dataset
from manip_il.collect.source import open_source
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.data.rewrite import rewrite_columns
from manip_il.errors import ManipError
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import EnvConfig
from manip_il.stock.table import ROBOT as STOCK

from ..damage import digests
from ..tables import every_scene

LABELS = (schema.ACTION, schema.LABEL_VALID, schema.EXPERT_PHASE)


def recorded(env: EnvConfig, count: int = 2, cameras: CameraConfig | None = None) -> list[Episode]:
    job = RolloutJob(env, hold=0, cameras=cameras)
    return sorted(job.run(stream_seeds("demonstrations", count)), key=lambda episode: episode.seed)


def without_labels(episode: Episode) -> Episode:
    """As if the expert had not been asked: other actions, no phase, not sound."""
    columns = dict(episode.columns)
    columns[schema.ACTION] = np.zeros_like(episode.columns[schema.ACTION])
    for key in LABELS[1:]:
        columns[key] = np.zeros_like(columns[key])
    return dataclasses.replace(episode, columns=columns)


def write(episodes: list[Episode], root: Path, env: EnvConfig, cameras: CameraConfig | None = None) -> Path:
    spec, fingerprint = env_spec(env, cameras), env_fingerprint(env, cameras)
    write_dataset(episodes, root, spec, repo_id="local/d", fingerprint=fingerprint, provenance={"round": 3})
    return root


def relabel(root: Path, target: Path, workers: int = 1) -> Changes:
    return relabel_dataset(open_source(root), target, repo_id="local/new", workers=workers)


def content(root: Path) -> dict[str, Any]:
    """All files but the one that says where the dataset comes from: tables, and digests of what is no table."""
    named = {name: digest for name, digest in digests(root).items() if name != layout.OURS}
    return {name: pq.read_table(root / name) if name.endswith(".parquet") else one for name, one in named.items()}


@every_scene
def test_labels_of_recorded_states_are_those_of_the_recording(robot, task):
    env = EnvConfig(robot, task, horizon=30)
    for episode in recorded(env, 1):
        for key, labels in label_states(env, episode.columns[schema.SIM_STATE]).items():
            np.testing.assert_array_equal(labels.reshape(episode.columns[key].shape), episode.columns[key])


def test_a_dataset_of_today_keeps_all_that_it_holds(tmp_path):
    env = EnvConfig()
    root = write(recorded(env), tmp_path / "demos", env)
    changes = relabel(root, tmp_path / "same")
    assert changes == Changes(episodes=2, frames=len(Dataset.open(root).columns()["index"]))
    assert content(tmp_path / "same") == content(root)
    provenance = Dataset.open(tmp_path / "same").provenance
    assert provenance["round"] == 3
    assert provenance["relabelled"]["from"] == "demos"


def test_lost_labels_come_back_with_their_statistics(tmp_path):
    env = EnvConfig("fetch", "reach")
    episodes = recorded(env, 3)
    whole, bare = (
        write(some, tmp_path / name, env)
        for some, name in ((episodes, "whole"), ([without_labels(one) for one in episodes], "bare"))
    )
    assert content(bare) != content(whole)
    changes = relabel(bare, tmp_path / "again", workers=2)
    assert changes.gained == changes.frames == len(Dataset.open(whole).columns()["index"])
    assert (changes.lost, changes.actions, changes.phases) == (0, 0, 0)
    assert content(tmp_path / "again") == content(whole)


def test_an_older_experts_labels_are_counted(tmp_path):
    env = EnvConfig("fetch", "reach")
    [episode] = recorded(env, 1)
    columns = dict(episode.columns)
    columns[schema.ACTION] = columns[schema.ACTION].copy()
    columns[schema.ACTION][3, 0] += 0.05
    columns[schema.ACTION][4, 0] += 1e-5  # nothing to speak of
    columns[schema.EXPERT_PHASE] = columns[schema.EXPERT_PHASE].copy()
    columns[schema.EXPERT_PHASE][5] += 1
    root = write([dataclasses.replace(episode, columns=columns)], tmp_path / "old", env)
    assert relabel(root, tmp_path / "new") == Changes(1, len(episode), actions=1, phases=1)


def test_stock_environments_are_relabelled_too(tmp_path):
    env = EnvConfig(STOCK, "FetchReach-v4")
    episodes = recorded(env, 1)
    root = write([without_labels(one) for one in episodes], tmp_path / "stock", env)
    relabel(root, tmp_path / "again")
    np.testing.assert_array_equal(
        Dataset.open(tmp_path / "again").columns()[schema.ACTION], episodes[0].columns[schema.ACTION]
    )


@pytest.mark.gl
@pytest.mark.slow
def test_videos_are_copied_and_lerobot_reads_all(tmp_path):
    env, cameras = EnvConfig("fetch", "reach"), CameraConfig(("front",), 64, 64)
    episodes = recorded(env, 2, cameras)
    whole, bare = (
        write(some, tmp_path / name, env, cameras)
        for some, name in ((episodes, "whole"), ([without_labels(one) for one in episodes], "bare"))
    )
    relabel(bare, tmp_path / "again")
    assert content(tmp_path / "again") == content(whole)
    dataset: Any = LeRobotDataset("local/new", root=tmp_path / "again")
    np.testing.assert_array_equal(dataset[5][schema.ACTION], episodes[0].columns[schema.ACTION][5])
    assert main(["data", "check", str(tmp_path / "again")]) == 0


def test_columns_of_another_length_are_refused_and_nothing_is_left(tmp_path):
    env = EnvConfig("fetch", "reach")
    root = write(recorded(env, 1), tmp_path / "demos", env)
    short = iter([{schema.LABEL_VALID: np.ones(3, np.int64)}])
    with pytest.raises(ManipError, match=r"episode 0 has \d+ frames, its new columns .'label_valid': 3"):
        rewrite_columns(root, tmp_path / "new", short, {})
    assert [path.name for path in tmp_path.iterdir()] == ["demos"]


def test_the_command_says_what_changed_and_what_comes_next(tmp_path, capsys):
    env = EnvConfig("fetch", "reach")
    root = write([without_labels(one) for one in recorded(env, 1)], tmp_path / "demos", env)
    assert main(["data", "relabel", str(root), "--workers=1", "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "states have a sound label now" in out
    assert f"dataset: {tmp_path / 'demos_relabelled'}" in out
    assert main(["data", "relabel", str(root), "--workers=1", "--quiet"]) == 2  # it is there already
    assert main(["data", "relabel", str(root), str(root), "--quiet"]) == 2
    assert "overlaps" in capsys.readouterr().err
    assert main(["data", "relabel", str(tmp_path), "--quiet"]) == 2
    again = ["data", "relabel", str(tmp_path / "demos_relabelled"), str(tmp_path / "twice"), "--workers=1", "--quiet"]
    assert main(again) == 0
    assert "all labels are as they were" in capsys.readouterr().out
