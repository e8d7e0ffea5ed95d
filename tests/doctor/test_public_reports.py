"""What users of LeRobot report of their datasets, tried here: each works, or is refused in one line
that helps.

Others are shown beside what they concern: fps 29.97 and exchanged messages in `tests/mcap`, another
program's dataset and its card in `tests/store/test_cards.py`, datasets of every shape that is
trained on in `tests/data`.
"""

import shutil
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
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


def index_without_a_name(root: Path) -> Path:
    pd.DataFrame({"task_index": [0]}, index=[TEXT]).to_parquet(root / layout.TASKS)
    table = pq.read_table(next(root.glob(layout.EPISODES_FILES)))
    texts = [[TEXT]] * len(table)
    place = table.column_names.index("tasks")
    pq.write_table(
        table.set_column(place, "tasks", [texts]), next(root.glob(layout.EPISODES_FILES))
    )
    return root


def modified(root: Path) -> Path:
    modify_tasks(theirs(root), new_task=TEXT)
    return root


def merged(root: Path) -> Path:
    merge_datasets(
        [theirs(root), theirs(modified(root))], "local/new", output_dir=root.with_name("new")
    )
    return root.with_name("new")


@pytest.mark.parametrize("change", [index_without_a_name, merged])
def test_a_dataset_that_lerobots_tools_changed_goes_through_every_command(
    change, tmp_path: Path, capsys
):
    original = shutil.copytree(SAMPLE, tmp_path / "demos")
    root = change(original)
    assert main(["data", "check", str(root)]) == 0
    if not (root / layout.OURS).is_file():
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
