"""What parquet files, statistics and videos would have other readers open or decode is refused
in one line.
"""

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from manip_il.bridges.store.transfer import open_remote, pull, push
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.gate import check_arrived
from manip_il.errors import ManipError
from manip_il.mdp import Episode

from ..damage import DATA, EPISODES, edit_json
from ..pictures import encoded, store_pictures, write

KEY = "observation.images.front"
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"
PICTURE = encoded(np.full((8, 8, 3), 90, np.uint8))


@pytest.fixture
def root(tmp_path: Path, episodes: list[Episode], spec: s.EnvironmentSpec) -> Path:
    """A dataset with a column of pictures, as LeRobot records it: without this program's own
    file.
    """
    root = write(episodes, tmp_path / "lift", spec)
    store_pictures(root, KEY, [PICTURE] * sum(map(len, episodes)), (8, 8))
    return root


def set_first(root: Path, cell: dict[str, Any] | None) -> None:
    table = pq.read_table(root / DATA)
    cells = table.column(KEY).to_pylist()
    column = pa.array([cell, *cells[1:]], layout.PICTURE)
    pq.write_table(table.set_column(table.column_names.index(KEY), KEY, column), root / DATA)


@pytest.mark.parametrize(
    "cell",
    [
        None,
        {"bytes": None, "path": "reference://x"},
        {"bytes": EPS, "path": None},
        {"bytes": b"", "path": "/a.png"},
    ],
    ids=["none", "address", "another format", "path"],
)
def test_a_cell_without_its_picture_is_followed_by_no_reader(root: Path, cell: Any):
    set_first(root, cell)
    with pytest.raises(ManipError, match=rf"cannot read .*lift/{DATA}"):
        Dataset.open(root).frames(KEY, np.array([0]))
    refused = rf"{DATA}: column '{KEY}' has no PNG or JPEG in row 0"
    with pytest.raises(ManipError, match=refused):
        check_arrived(root)


def test_such_a_dataset_is_not_pulled(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    remote = open_remote(f"file://{tmp_path}/store", quiet=True)
    set_first(root, {"bytes": None, "path": "http://127.0.0.1:1/a.png"})
    # another program pushed it
    monkeypatch.setattr("manip_il.bridges.store.transfer.examine_folder", lambda root: [])
    push(root, remote)
    with pytest.raises(ManipError, match=rf"{DATA}: column '{KEY}' has no PNG or JPEG in row 0"):
        pull(remote, tmp_path / "here")
    assert not (tmp_path / "here").exists()


def test_a_hidden_decoder_beside_real_pictures_is_refused(root: Path):
    path = root / EPISODES
    table = pq.read_table(path)
    about = '{"info": {"features": {"tasks": {"_\\u0074ype": "Image"}}}}'
    pq.write_table(table.replace_schema_metadata({"huggingface": about}), path)
    with pytest.raises(
        ManipError, match=rf"{EPISODES}: column 'tasks' is decoded as .*; expected plain values"
    ):
        check_arrived(root)
    table = table.append_column(
        KEY, pa.array([{"bytes": PICTURE, "path": None}] * len(table), layout.PICTURE)
    )
    pq.write_table(
        table.replace_schema_metadata({"huggingface": about.replace("tasks", KEY)}), path
    )
    with pytest.raises(ManipError, match=rf"{EPISODES}: column '{KEY}' holds struct"):
        check_arrived(root)


def test_a_type_that_a_library_registers_is_refused(root: Path):
    table = pq.read_table(root / DATA)
    odd = pa.field("odd", pa.string(), metadata={"ARROW:extension:name": "arrow.py_extension_type"})
    pq.write_table(table.append_column(odd, pa.array([""] * len(table))), root / DATA)
    with pytest.raises(ManipError, match=r"column 'odd' holds string; expected plain values"):
        check_arrived(root)


def test_a_picture_has_the_size_in_info_before_it_is_decoded(root: Path):
    huge = encoded(np.zeros((12_000, 12_000), np.uint8))
    set_first(root, {"bytes": huge, "path": None})
    expected = r"12000 x 12000; expected 8 x 8, as in info\.json"
    with pytest.raises(ManipError, match=expected):
        check_arrived(root)
    tracemalloc.start()
    with pytest.raises(ManipError, match=expected):
        Dataset.open(root).frames(KEY, np.array([0]))
    assert tracemalloc.get_traced_memory()[1] < 12_000**2
    tracemalloc.stop()


def test_a_film_has_the_size_in_info_before_it_is_decoded(
    tmp_path: Path, two: s.EnvironmentSpec, filmed: list[Episode]
):
    root = write(filmed, tmp_path / "film", two)
    edit_json(root / layout.INFO, lambda info: info["features"][KEY].update(shape=[8, 8, 3]))
    with pytest.raises(ManipError, match=r"72 x 96; expected 8 x 8, as in info\.json"):
        check_arrived(root)
    with pytest.raises(ManipError, match=r"72 x 96; expected 8 x 8, as in info\.json"):
        Dataset.open(root).frames(KEY, np.array([0]))


@pytest.mark.slow
def test_what_lerobot_and_datasets_write_passes(tmp_path: Path):
    """Language columns, matrices and pictures, written by LeRobot, merged by it, and through
    pandas.
    """
    from lerobot.datasets.aggregate import aggregate_datasets
    from lerobot.datasets.io_utils import write_table_one_row_group_per_episode
    from lerobot.datasets.language import language_events_column_feature, language_feature_info
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    import datasets

    table: dict[str, Any] = {
        "matrix": {"dtype": "float32", "shape": (2, 3), "names": None},
        "note": {"dtype": "string", "shape": (1,), "names": None},
        KEY: {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
        "film": {"dtype": "video", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
    }
    dataset: Any = LeRobotDataset.create("a/b", 10, table, root=tmp_path / "one")
    for _ in range(3):
        film, picture = np.zeros((64, 64, 3), np.uint8), np.zeros((8, 8, 3), np.uint8)
        matrix = np.zeros((2, 3), np.float32)
        dataset.add_frame(
            {"matrix": matrix, "note": "a", KEY: picture, "film": film, "task": "wipe"}
        )
    dataset.save_episode()
    dataset.finalize()
    check_arrived(tmp_path / "one")
    aggregate_datasets(["a/b"], "a/c", [tmp_path / "one"], tmp_path / "merged")
    check_arrived(tmp_path / "merged")
    call = {"role": "user", "content": "a", "style": "vqa", "camera": KEY, "tool_calls": [{"a": 1}]}
    features = datasets.Features({"language_events": language_events_column_feature()})
    written: Any = datasets.Dataset.from_dict(
        {"language_events": [[call]] * 3}, features
    ).with_format("arrow")[:]
    said = pq.read_table(tmp_path / "one" / DATA).append_column(
        "language_events", written.column(0)
    )
    write_table_one_row_group_per_episode(said, tmp_path / "one" / DATA)
    datasets.Dataset.from_parquet(str(tmp_path / "one" / DATA)).to_parquet(tmp_path / "one" / DATA)
    told = language_feature_info()["language_events"] | {"shape": [1]}
    edit_json(
        tmp_path / "one" / layout.INFO, lambda info: info["features"].update(language_events=told)
    )
    check_arrived(tmp_path / "one")
    frame = pq.read_table(tmp_path / "one" / EPISODES).to_pandas()
    frame.to_parquet(tmp_path / "one" / EPISODES, index=False)
    check_arrived(tmp_path / "one")


DECODED: dict[str, Any] = {
    "another picture": {"_type": "Image"},
    "in a list": {"feature": {"_type": "Image"}, "_type": "List"},
}


@pytest.mark.parametrize("name", [DATA, EPISODES, layout.TASKS])
@pytest.mark.parametrize("kind", DECODED)
def test_a_files_own_metadata_has_nothing_decoded(root: Path, name: str, kind: str):
    table = pq.read_table(root / name)
    rows = [{"bytes": None, "path": "http://127.0.0.1:1/a"}] * len(table)
    table = table.append_column("odd", pa.array(rows, layout.PICTURE))
    about = json.dumps({"info": {"features": {"odd": DECODED[kind]}}})
    pq.write_table(table.replace_schema_metadata({"huggingface": about}), root / name)
    with pytest.raises(
        ManipError, match=rf"{name}: column 'odd' holds struct.*; expected plain values"
    ):
        check_arrived(root)


def test_a_playlist_is_no_video(tmp_path: Path, two: s.EnvironmentSpec, filmed: list[Episode]):
    root = write(filmed, tmp_path / "film", two)
    path = next(root.glob("videos/**/*.mp4"))
    path.write_bytes(
        b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:1/a.ts\n"
        + path.read_bytes()
    )
    with pytest.raises(ManipError, match=r"\.mp4: Invalid data found"):
        check_arrived(root)
