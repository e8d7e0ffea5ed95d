"""The dataset that comes along with the project."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from manip_il.bridges.doctor.examine import examine_folder
from manip_il.cli.main import main
from manip_il.data.dataset import Dataset

from ..damage import digests

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "datasets" / "sample"

# What is promised across processors: contacts amplify the last bits along an episode.
EPISODE_TOLERANCE = 0.05  # [rad], [m], and of entries of rotations
PLAIN_KERNELS = {"x86_64": "Nehalem", "aarch64": "ARMV8"}  # what OpenBLAS calls them


def test_it_is_small_and_whole():
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) < 1_000_000
    assert examine_folder(SAMPLE) == []


def test_it_holds_ten_successful_episodes_of_pick_place():
    dataset = Dataset.open(SAMPLE)
    assert (dataset.spec.robot, dataset.spec.task) == ("panda", "pick_place")
    assert (dataset.info.episodes, dataset.count_successes()) == (10, 10)
    table = Dataset.open(SAMPLE).columns(["label_valid", "actor"])
    assert table["label_valid"].all()
    assert not table["actor"].any()  # the expert drove


@pytest.mark.slow
def test_it_can_be_recorded_again(tmp_path):
    again = tmp_path / "sample"
    assert (
        main(["record", "--dataset.num_episodes=10", f"--dataset.root={again}", "--workers=1"]) == 0
    )
    assert np.array_equal(
        Dataset.open(SAMPLE).columns()["seed"], Dataset.open(again).columns()["seed"]
    )
    differing = {
        key
        for key, ours in Dataset.open(SAMPLE).fingerprint.items()
        if Dataset.open(again).fingerprint.get(key) != ours
    }
    # else the same model
    assert "model_sha256" not in differing or differing & {"mujoco", "processor"}
    if not differing:
        assert digests(SAMPLE) == digests(again)
    elif differing == {"processor"}:
        assert_same_within_tolerance(SAMPLE, again)
    # else other versions of the simulator: the same tasks, other numbers


@pytest.mark.slow
def test_another_processor_records_the_same_within_the_tolerance(tmp_path):
    """BLAS and numpy are told that the processor has no vector extensions to speak of: other
    last bits.
    """
    again, other = tmp_path / "again", tmp_path / "other"
    words = ["record", "--dataset.num_episodes=3", "--dataset.repo_id=local/sample", "--workers=1"]
    assert main([*words, f"--dataset.root={again}"]) == 0
    plain = {
        "OPENBLAS_CORETYPE": PLAIN_KERNELS[platform.machine()],
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
    }
    command = [sys.executable, "-m", "manip_il.cli.main", *words, f"--dataset.root={other}"]
    subprocess.run(command, check=True, cwd=ROOT, env=os.environ | plain)
    assert (
        Dataset.open(again).fingerprint["processor"] != Dataset.open(other).fingerprint["processor"]
    )
    assert digests(again) != digests(other)  # else this shows nothing
    assert_same_within_tolerance(again, other)


def assert_same_within_tolerance(left: Path, right: Path) -> None:
    """Steps, outcomes and phases are equal, what was measured and labelled nearly."""
    ours, theirs = Dataset.open(left).columns(), Dataset.open(right).columns()
    assert ours.keys() == theirs.keys()
    for key, column in ours.items():
        if key == "sim_state":
            continue  # holds the solver's warm start, which is no quantity of the world
        if column.dtype.kind == "f":
            np.testing.assert_allclose(
                column, theirs[key], rtol=0, atol=EPISODE_TOLERANCE, err_msg=key
            )
        else:
            assert np.array_equal(column, theirs[key]), key
