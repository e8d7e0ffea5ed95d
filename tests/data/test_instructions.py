"""Episodes that each have a text of their own: what a dataset makes of them, and everything that
reads it.
"""

import json
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.build import build
from manip_il.data.dataset import Dataset
from manip_il.data.journal import Journal, read_journal
from manip_il.data.lerobot_write import write_dataset
from manip_il.mdp import Episode

from ..pictures import read_episodes

RED, BLUE = "Put the red cube into its bin.", "Put the blue cube into its bin."
TEXTS = [RED, BLUE, RED]


@pytest.fixture
def told(episodes: list[Episode]) -> list[Episode]:
    return [
        replace(episode, instruction=text) for episode, text in zip(episodes, TEXTS, strict=True)
    ]


@pytest.fixture
def root(tmp_path: Path, told: list[Episode], spec: s.EnvironmentSpec) -> Path:
    write_dataset(told, tmp_path / "data", spec, fingerprint={})
    return tmp_path / "data"


def texts(root: Path) -> list[str]:
    return [episode.instruction for episode in read_episodes(root)]


def test_each_text_is_one_task_and_every_frame_has_its_own(root, spec):
    table = pq.read_table(root / layout.TASKS)
    assert table.to_pydict() == {"task_index": [0, 1], "task": [RED, BLUE]}
    assert json.loads((root / layout.INFO).read_text())["total_tasks"] == 2
    assert (
        Dataset.open(root).columns(["task_index"])["task_index"].tolist()
        == [0] * 7 + [1] + [0] * 12
    )
    rows = (
        pq.read_table(next(root.glob(layout.EPISODES_FILES)), columns=["tasks"])
        .column("tasks")
        .to_pylist()
    )
    assert rows == [[text] for text in TEXTS]
    assert texts(root) == TEXTS
    assert Dataset.open(root).spec.instruction == spec.instruction


def test_journals_keep_the_text_and_build_the_same_dataset(tmp_path, told, spec, root):
    paths = [Journal(tmp_path / "journals", spec, {}).write(episode) for episode in told]
    assert [read_journal(path)[1].instruction for path in paths] == TEXTS
    build(tmp_path / "journals", tmp_path / "built")
    assert texts(tmp_path / "built") == TEXTS
    for name in (layout.TASKS, layout.INFO):
        assert (tmp_path / "built" / name).read_bytes() == (root / name).read_bytes()
