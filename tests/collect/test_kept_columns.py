"""A dataset that somebody has added columns and texts to keeps them through everything that
rewrites it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from manip_il.cli.main import main
from manip_il.data import lerobot_layout as layout
from manip_il.data.dataset import Dataset
from manip_il.data.statistics import column_statistics, to_lists
from manip_il.sim.config import CameraConfig

from ..damage import DATA, EPISODES, edit_json
from .test_edits import REACH, recorded, write

TEXTS = ["look", "reach out", "hold still"]
FORCE, NOTE = "force", "note"


def add_columns(root: Path) -> None:
    """Give a dataset two columns, a text for each third of an episode, a table of its own and an
    operator.
    """
    table = pq.read_table(root / DATA)
    count = len(table)
    force = np.random.default_rng(count).normal(10_000, 0.3, (count, 2)).astype(np.float32)
    frames = table.column("frame_index").to_numpy()
    numbers = np.minimum(frames // 3, len(TEXTS) - 1)
    place = table.schema.get_field_index("task_index")
    table = table.set_column(place, "task_index", pa.array(numbers, pa.int64()))
    table = table.append_column(FORCE, pa.array(force.tolist(), pa.list_(pa.float32(), 2)))
    table = table.append_column(NOTE, pa.array([f"é {frame}" for frame in frames]))
    pq.write_table(table, root / DATA)
    pq.write_table(layout.tasks_table(TEXTS), root / layout.TASKS)
    pq.write_table(pa.table({"subtask": ["grasp"]}), root / "meta/subtasks.parquet")
    episodes = pq.read_table(root / EPISODES)
    rows: list[dict[str, Any]] = episodes.to_pylist()
    pq.write_table(
        pa.Table.from_pylist([row | {"tasks": TEXTS, "operator": "Ada"} for row in rows]),
        root / EPISODES,
    )
    added = {FORCE: {"dtype": "float32", "shape": [2], "names": ["x", "y"]}}
    added |= {NOTE: {"dtype": "string", "shape": [1], "names": None}}
    edit_json(
        root / layout.INFO,
        lambda info: info["features"].update(added) or info.update(total_tasks=len(TEXTS)),
    )
    edit_json(
        root / layout.STATS, lambda stats: stats.update(to_lists(column_statistics({FORCE: force})))
    )


def content(root: Path) -> tuple[dict[str, Any], list[str]]:
    """All columns of a dataset but the numbers of its rows, and every frame's text."""
    dataset = Dataset.open(root)
    names = [key for key in dataset.stored_features if key not in dataset.cameras]
    table = dataset.columns([*names, "task_index"])
    return {key: table[key].tolist() for key in names}, [
        dataset.tasks[one] for one in table["task_index"].tolist()
    ]


def run(*words: object) -> None:
    assert main([*map(str, words)]) == 0


@pytest.fixture
def somebodys(tmp_path: Path) -> list[Path]:
    episodes = recorded(REACH)
    roots = [write([one], tmp_path / name, REACH) for one, name in zip(episodes, "ab", strict=True)]
    for root in roots:
        add_columns(root)
    return roots


@pytest.mark.slow
def test_columns_and_texts_survive_a_merge_new_labels_and_mcap(somebodys, tmp_path):
    (columns, texts), (more, later) = map(content, somebodys)
    expected = {key: values + more[key] for key, values in columns.items()}, texts + later
    assert {*texts} == {*TEXTS}
    both, new, back = tmp_path / "both", tmp_path / "both_relabelled", tmp_path / "back"
    run("data", "check", somebodys[0])
    run("train", f"--dataset.root={somebodys[0]}", "--steps=2", f"--output_dir={tmp_path / 'run'}")
    run("data", "merge", *somebodys, f"--output={both}")
    run("data", "relabel", both, "--workers=1")
    run("data", "to-mcap", new, tmp_path / "out")
    run("data", "from-mcap", tmp_path / "out", back, f"--mapping={tmp_path / 'out/mapping.yaml'}")
    for root in (both, new, back):
        run("data", "check", root)
        assert content(root) == expected
    for root in (both, new):
        assert [row["operator"] for row in Dataset.open(root).episodes.others] == ["Ada", "Ada"]
        assert pq.read_table(root / "meta/subtasks.parquet").to_pydict() == {"subtask": ["grasp"]}
        assert Dataset.open(root).statistics[FORCE]["std"] == pytest.approx(
            np.std(expected[0][FORCE], axis=0)
        )


@pytest.mark.gl
def test_columns_and_texts_survive_other_pictures(somebodys, tmp_path):
    from manip_il.collect.edits import EditTarget, open_source, render_dataset

    render_dataset(
        open_source(somebodys[0]), CameraConfig(("front",), 32, 32), EditTarget(tmp_path / "seen")
    )
    columns, texts = content(tmp_path / "seen")
    before, told = content(somebodys[0])
    assert ({key: columns[key] for key in before}, texts) == (before, told)
