"""Paths of a LeRobot v3.0 dataset and the Arrow types of its columns (lerobot 0.6.1,
`datasets/utils.py`).

Copied here (and tests compare the two), because importing `lerobot.datasets` imports torch, which
takes seconds.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from manip_il.data.atomic import write_file

Features = dict[str, dict[str, Any]]  # column or camera -> dtype, shape per frame, names
VERSION = "v3.0"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
OURS = "meta/manip_il.json"  # spec, fingerprint, provenance; LeRobot ignores it
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
DATA_FILES = "data/*/*.parquet"
EPISODES_FILES = "meta/episodes/*/*.parquet"
CHUNKS_SIZE = 1000  # files per chunk folder
DATA_FILES_SIZE_IN_MB = 100
VIDEO_FILES_SIZE_IN_MB = 200

TIMESTAMP = "timestamp"
FRAME_INDEX = "frame_index"
EPISODE_INDEX = "episode_index"
INDEX = "index"
TASK_INDEX = "task_index"
DRAWN = "drawn"  # our column in meta/episodes: an episode's random draws, as JSON

INDEX_DTYPES = {TIMESTAMP: "float32"} | dict.fromkeys(
    (FRAME_INDEX, EPISODE_INDEX, INDEX, TASK_INDEX), "int64"
)
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
# a file's content and its original name
PICTURE = pa.struct({"bytes": pa.binary(), "path": pa.string()})
_TASK_IS_INDEX = (  # in pandas' words
    '{"index_columns": ["task"], "column_indexes": [], "columns": [{"name": "task_index",'
    ' "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": null},'
    ' {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object",'
    ' "metadata": null}], "pandas_version": "2.3.3"}'
)
STAT_NAMES = ("min", "max", "mean", "std", "count", *QUANTILES)


def data_schema(features: Features, columns: Mapping[str, Any]) -> pa.Schema:
    """Return the Arrow schema of the data files.

    Shape (1,) becomes a plain value, a vector a list of fixed size. The schema's metadata describes
    the columns in the form that Hugging Face's package `datasets` reads.

    Args:
        features: The columns and cameras.
        columns: The columns of an episode; types that are not LeRobot's for numbers, text or
            pictures, such as language, are kept.
    """
    types: dict[str, pa.DataType] = {}
    hugging_face: dict[str, Any] = {}
    for key, feature in features.items():
        dtype, shape = feature["dtype"], feature["shape"]
        if dtype == "video":  # stored in separate files
            continue
        if dtype == "image":
            types[key] = PICTURE
            hugging_face[key] = {"_type": "Image"}
            continue
        if isinstance(columns[key], pa.ChunkedArray) and dtype != "string":
            types[key] = columns[key].type
            continue
        types[key] = pa.type_for_alias(dtype)
        hugging_face[key] = {"dtype": dtype, "_type": "Value"}
        if len(shape) > 1:
            hugging_face[key] |= {"shape": list(shape), "_type": f"Array{len(shape)}D"}
            for _ in shape:
                types[key] = pa.list_(types[key])
        elif shape != (1,):
            types[key] = pa.list_(types[key], shape[0])
            hugging_face[key] = {"feature": hugging_face[key], "length": shape[0], "_type": "List"}
    metadata = {"huggingface": json.dumps({"info": {"features": hugging_face}})}
    return pa.schema([*types.items()], metadata=metadata)


def tasks_table(instructions: Sequence[str]) -> pa.Table:
    """Return the table of tasks, with `task` as pandas' index, because LeRobot looks tasks up by
    this index.
    """
    numbers = pa.array(range(len(instructions)), pa.int64())
    table = pa.table({TASK_INDEX: numbers, "task": pa.array(instructions, pa.string())})
    return table.replace_schema_metadata({"pandas": _TASK_IS_INDEX})


def numbered(template: str, number: int, **names: str) -> tuple[str, int, int]:
    """Return the path, the chunk index and the file index of a numbered file.

    Args:
        template: The path, with the fields `chunk_index` and `file_index`.
        number: The file's number, from 0.
        names: Values of the template's other fields.
    """
    chunk, file = divmod(number, CHUNKS_SIZE)
    return template.format(chunk_index=chunk, file_index=file, **names), chunk, file


def write_json(path: Path, data: Any) -> None:
    """Write `data` in LeRobot's JSON layout, atomically as `write_file` does."""
    write_file(path, json.dumps(data, indent=4, ensure_ascii=False).encode())
