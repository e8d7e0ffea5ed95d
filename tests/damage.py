"""Ways to damage a dataset, and what the doctor says then."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from manip_il.data import lerobot_layout as layout

DATA = layout.DATA_PATH.format(chunk_index=0, file_index=0)
EPISODES = layout.EPISODES_PATH.format(chunk_index=0, file_index=0)


def lines(root: Path) -> list[str]:
    from manip_il.bridges.doctor.examine import examine_folder

    return [str(finding) for finding in examine_folder(root)]


def edit_json(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def edit_table(path: Path, change: Callable[[dict[str, list[Any]]], None]) -> None:
    """Change columns, given as lists of rows, under the file's own schema."""
    table = pq.ParquetFile(path).read()
    columns = table.to_pydict()
    change(columns)
    pq.write_table(pa.table(columns, schema=table.schema), path)


def cut(path: Path, keep: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def digests(root: Path) -> dict[str, str]:
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }


def check_same_data(run: Path, other: Path) -> None:
    """Check that two runs have the same files, of which those of data have the same bytes."""
    ours, theirs = digests(run), digests(other)
    assert ours.keys() == theirs.keys()
    data = [
        name for name in ours if name.endswith((".parquet", ".mcap", ".safetensors", "eval.json"))
    ]
    assert [ours[name] for name in data] == [theirs[name] for name in data]
