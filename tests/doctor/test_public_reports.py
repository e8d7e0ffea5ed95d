"""What users of LeRobot report of their datasets, tried here: each works, or is refused in one line
that helps.

Others are shown beside what they concern: fps 29.97 and exchanged messages in `tests/mcap`, another
program's dataset and its card in `tests/store/test_cards.py`, datasets of every shape that is
trained on in `tests/data`.
"""

import shutil
from pathlib import Path

import pytest
from lerobot.datasets.dataset_tools import merge_datasets, modify_tasks
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il.bridges.store.hub import write_cards
from manip_il.cli.main import main
from manip_il.data import lerobot_layout as layout
from manip_il.data.dataset import Dataset

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
PACKAGE, SAMPLE = ROOT / "manip_il", ROOT / "datasets" / "sample"
TEXT = "Put the cube down."


def theirs(root: Path) -> LeRobotDataset:
    return LeRobotDataset(f"local/{root.name}", root=root)


def modified(root: Path) -> Path:
    modify_tasks(theirs(root), new_task=TEXT)
    return root


def merged(root: Path) -> Path:
    merge_datasets(
        [theirs(root), theirs(modified(root))], "local/new", output_dir=root.with_name("new")
    )
    return root.with_name("new")


def test_a_dataset_that_lerobots_tools_changed_goes_through_every_command(tmp_path: Path, capsys):
    root = merged(shutil.copytree(SAMPLE, tmp_path / "demos"))
    assert main(["data", "check", str(root)]) == 0
    capsys.readouterr()
    assert main(["data", "relabel", str(root)]) == 1
    assert "copy it from the dataset that this one was made from\n" in capsys.readouterr().err
    shutil.copy(SAMPLE / layout.OURS, root / layout.OURS)
    new = tmp_path / "relabelled"
    assert main(["data", "relabel", str(root), str(new), "--workers=1"]) == 0
    assert main(["data", "to-mcap", str(new), str(tmp_path / "mcap")]) == 0
    assert main(["push", str(new), f"file://{tmp_path}/store"]) == 0
    assert Dataset.open(new).instruction == TEXT
    assert TEXT in write_cards(root, "dataset", "a/b", tmp_path)["README.md"].read_text()
