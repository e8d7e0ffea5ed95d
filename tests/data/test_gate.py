"""What parquet files, statistics and videos would have other readers open or decode is refused in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.gate import check_arrived
from manip_il.errors import ManipError
from manip_il.mdp import Episode
from manip_il.store.transfer import open_remote, pull, push

from ..damage import DATA, EPISODES
from ..pictures import encoded, store_pictures, write

KEY = "observation.images.front"
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"
PICTURE = encoded(np.full((8, 8, 3), 90, np.uint8))


@pytest.fixture
def root(tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    """A dataset with a column of pictures, as LeRobot records it: without this program's own file."""
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
    [None, {"bytes": None, "path": "reference://x"}, {"bytes": EPS, "path": None}, {"bytes": b"", "path": "/a.png"}],
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
    monkeypatch.setattr("manip_il.store.transfer.examine_folder", lambda root: [])  # another program pushed it
    push(root, remote)
    with pytest.raises(ManipError, match=rf"{DATA}: column '{KEY}' has no PNG or JPEG in row 0"):
        pull(remote, tmp_path / "here")
    assert not (tmp_path / "here").exists()


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
    with pytest.raises(ManipError, match=rf"{name}: column 'odd' holds struct.*; expected plain values"):
        check_arrived(root)


def test_a_playlist_is_no_video(tmp_path: Path, two: s.RobotTaskSpec, filmed: list[Episode]):
    root = write(filmed, tmp_path / "film", two)
    path = next(root.glob("videos/**/*.mp4"))
    path.write_bytes(b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:1/a.ts\n" + path.read_bytes())
    with pytest.raises(ManipError, match=r"\.mp4: Invalid data found"):
        check_arrived(root)
