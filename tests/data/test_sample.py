"""The dataset that comes along with the project."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from manip_il.cli.main import main
from manip_il.data.doctor.examine import examine_folder
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.lerobot_io import dataset_info, read_fingerprint, read_table

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "datasets" / "sample"


def test_it_is_small_and_whole():
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) < 1_000_000
    assert examine_folder(SAMPLE) == []


def test_it_holds_ten_successful_episodes_of_pick_place():
    info = dataset_info(SAMPLE)
    assert (info.robot, info.task, info.episodes, info.success) == ("panda", "pick_place", 10, 10)
    table = read_table(SAMPLE, ["label_valid", "actor"])
    assert table["label_valid"].all()
    assert not table["actor"].any()  # the expert drove


def test_lerobots_loader_reads_it():
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("local/sample", root=SAMPLE)
    assert (len(dataset), dataset.num_episodes) == (373, 10)
    assert dataset.hf_dataset[0]["action"].shape == (8,)


def test_git_does_not_ignore_it():
    done = subprocess.run(["git", "check-ignore", "datasets/sample/meta/info.json"], cwd=ROOT, check=False)
    assert done.returncode != 0


@pytest.mark.slow
def test_it_can_be_recorded_again(tmp_path: Path):
    again = tmp_path / "sample"
    assert main(["record", "--dataset.num_episodes=10", f"--dataset.root={again}", "--workers=1"]) == 0
    ours, theirs = read_table(SAMPLE), read_table(again)
    assert np.array_equal(ours["seed"], theirs["seed"])
    if compare_fingerprints("the sample", read_fingerprint(SAMPLE), "this", read_fingerprint(again)):
        return  # other versions of the simulator: the same tasks, other numbers
    for path in (path for path in SAMPLE.rglob("*") if path.is_file()):
        assert path.read_bytes() == (again / path.relative_to(SAMPLE)).read_bytes(), path.name
