"""Parquet files of datasets: write numbered files by row groups, read columns, tasks and the table
of episodes.

The random draws of an episode are a column of ours in `meta/episodes`, one JSON object per episode.
LeRobot's merge keeps the column, its split and delete drop it; the draws are also part of
`sim_state`.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.info import NUMBERS, Feature, Info, reading
from manip_il.data.statistics import Statistics
from manip_il.errors import ManipError
from manip_il.mdp import I64

Column = Any  # numpy array, (T,) or (T, ...); of datasets, all but numbers are Arrow arrays

# LeRobot's columns of `meta/episodes`
_EPISODE_COLUMNS = re.compile(
    r"episode_index|tasks|length|dataset_(from|to)_index|(data|meta|stats|videos)/.*"
)


class ParquetFiles:
    """Writes numbered parquet files, one at a time: when a file is full, the next one is started.

    A writer keeps a description of every row group in memory until the file is closed, so many
    small groups would need more memory than the rows.

    Args:
        folder: Folder of the dataset.
        template: The files' path in it, with the fields `chunk_index` and `file_index`.
        group_rows: Least number of rows in a row group; a file's last one may have fewer.
    """

    def __init__(self, folder: Path, template: str, group_rows: int = 1):
        self._folder, self._template = folder, template
        self._limit, self._group_rows = layout.DATA_FILES_SIZE_IN_MB * 2**20, group_rows
        self._number = 0
        self._path = folder
        self._writer: pq.ParquetWriter | None = None
        self._waiting: list[pa.Table] = []
        self._waiting_bytes = 0

    def next_place(self) -> tuple[int, int]:
        """Return the chunk and file index of the next rows."""
        written = self._path.stat().st_size if self._writer is not None else 0
        if written + self._waiting_bytes >= self._limit:
            self.close()
        return layout.numbered(self._template, self._number)[1:]

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Append rows; return their chunk and file index."""
        place = self.next_place()
        self._waiting.append(table)
        self._waiting_bytes += table.nbytes
        if sum(map(len, self._waiting)) >= self._group_rows:
            self._flush()
        return place

    def close(self) -> None:
        """Close the open file, if any; the next write starts a new one."""
        if self._waiting:
            self._flush()
        if self._writer is not None:
            writer = self._writer
            self._writer = None  # first, so that an error on closing is raised once
            writer.close()
            self._number += 1

    def _flush(self) -> None:
        table = pa.concat_tables(self._waiting).combine_chunks()
        self._waiting, self._waiting_bytes = [], 0
        if self._writer is None:
            self._path = self._folder / layout.numbered(self._template, self._number)[0]
            self._path.parent.mkdir(parents=True, exist_ok=True)
            repeating: Any = [
                field.name for field in table.schema if not pa.types.is_nested(field.type)
            ]
            self._writer = pq.ParquetWriter(
                *(self._path, table.schema),
                compression="snappy",
                use_dictionary=repeating,  # numbers in vectors seldom repeat
                write_page_checksum=True,  # detects changed bits
            )
        self._writer.write_table(table)


def to_table(columns: Mapping[str, Column], schema: pa.Schema) -> pa.Table:
    """Return columns (T,) and (T, ...) as an Arrow table: vectors as lists, pictures as PNG."""
    arrays: list[pa.Array | pa.ChunkedArray] = []
    for column in schema:
        values = columns[column.name]
        if isinstance(values, pa.ChunkedArray):
            arrays.append(values.cast(column.type))
        elif column.type == layout.PICTURE:
            arrays.append(
                pa.array(
                    [{"bytes": _to_png(picture), "path": None} for picture in values], column.type
                )
            )
        elif values.ndim > 2:
            arrays.append(pa.array(values.tolist(), column.type))
        elif values.ndim > 1:
            flat = pa.array(np.ascontiguousarray(values).reshape(-1), column.type.value_type)
            arrays.append(
                pa.FixedSizeListArray.from_arrays(flat, values.shape[1]).cast(column.type)
            )
        else:
            arrays.append(pa.array(values, column.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def _to_png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture (height, width, 3) as the content of a PNG file."""
    stream = BytesIO()
    # higher levels save a tenth and take twice as long
    Image.fromarray(picture).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


@contextmanager
def open_parquet(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a parquet file for reading. Raises `ManipError` if it is damaged or not regular."""
    with (
        reading(path),
        checks.native_path(path, "a parquet file") as opened,
        pq.ParquetFile(opened, page_checksum_verification=True) as file,
    ):
        yield file


def column_names(path: Path) -> list[str]:
    """Return the names of a parquet file's columns. Raises what `open_parquet` raises."""
    with open_parquet(path) as file:
        return file.schema_arrow.names


def count_rows(path: Path) -> int:
    """Return the number of rows in a parquet file. Raises what `open_parquet` raises."""
    with open_parquet(path) as file:
        return file.metadata.num_rows


def read_file(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return the requested columns that a file has. Raises what `open_parquet` raises."""
    with open_parquet(path) as file:
        # one thread: distributing pieces of one episode costs more than reading them
        return file.read(list(columns), use_threads=False).replace_schema_metadata(None)


def read_tasks(root: Path) -> dict[int, str]:
    """Return the task texts by `task_index`.

    The file has them in pandas' index column, which may have no name.
    """
    path = root / layout.TASKS
    with reading(path):
        names = column_names(path)
        table = read_file(path, names)
        name = "task" if "task" in names else names[-1]  # pandas writes the index after the columns
        return dict(
            zip(
                table.column(layout.TASK_INDEX).to_pylist(),
                table.column(name).to_pylist(),
                strict=True,
            )
        )


def to_numpy(column: pa.ChunkedArray, feature: Feature) -> Column:
    """Return a column of numbers, (T,) or (T, *shape), with its feature's dtype.

    Others as they are.

    Raises `ValueError` if values have another kind or shape, or are missing.
    """
    if feature.dtype not in NUMBERS:
        return column
    array: Any = column.combine_chunks()
    is_vector = feature.size > 1
    while isinstance(array, pa.ExtensionArray | pa.ListArray | pa.FixedSizeListArray):
        array = array.storage if isinstance(array, pa.ExtensionArray) else array.flatten()
        is_vector = True
    try:  # files may hold narrower numbers
        values = array.to_numpy(zero_copy_only=False).astype(
            feature.dtype, casting="same_kind", copy=False
        )
        return values.reshape(len(column), *feature.shape if is_vector else ())
    except (TypeError, ValueError) as error:
        what = f"{feature.dtype} of shape {list(feature.shape)}"
        raise ValueError(
            f"{feature.key!r} does not hold {what} in each of {len(column):,} rows: {error}"
        ) from error


@dataclass(frozen=True)
class EpisodeTable:
    """Columns with one entry per episode.

    Attributes:
        index: Indices of the episodes.
        length: Numbers of frames.
        start: First rows.
        stop: Last rows plus one.
        tasks: Texts of the tasks.
        clips: Column of a camera -> each episode's video file, and its start in it [s].
        others: Values in the columns that LeRobot does not have.
    """

    index: I64
    length: I64
    start: I64
    stop: I64
    tasks: list[list[str]]
    clips: dict[str, list[tuple[str, float]]]
    others: list[dict[str, Any]]

    def __len__(self) -> int:
        return len(self.index)


def read_episode_table(root: Path, info: Info) -> EpisodeTable:
    """Read `meta/episodes`, without statistics.

    Raises `ManipError` naming a file that cannot be read.
    """
    with reading(root / "meta/episodes"):
        table = _read_rows(root, lambda name: not name.startswith("stats/"))

        def numbers(name: str) -> I64:
            return table.column(name).cast(pa.int64()).to_numpy()

        def clips(key: str) -> list[tuple[str, float]]:
            chunks = numbers(f"videos/{key}/chunk_index").tolist()
            files = numbers(f"videos/{key}/file_index").tolist()
            starts = table.column(f"videos/{key}/from_timestamp").to_pylist()
            return [
                (layout.VIDEO_PATH.format(chunk_index=chunk, file_index=file, video_key=key), start)
                for chunk, file, start in zip(chunks, files, starts, strict=True)
            ]

        tasks = (
            table.column("tasks").to_pylist()
            if "tasks" in table.column_names
            else [None] * len(table)
        )
        others = [name for name in table.column_names if not _EPISODE_COLUMNS.fullmatch(name)]
        return EpisodeTable(
            index=numbers(layout.EPISODE_INDEX),
            length=numbers("length"),
            start=numbers("dataset_from_index"),
            stop=numbers("dataset_to_index"),
            tasks=[texts or [] for texts in tasks],
            clips={feature.key: clips(feature.key) for feature in info.of_dtype("video")},
            others=table.select(others).to_pylist(),
        )


def read_picture_statistics(root: Path, cameras: Sequence[str]) -> list[Statistics]:
    """Return the stored statistics of every episode's pictures, by camera column."""
    found: list[Statistics] = []
    columns = {f"stats/{key}/{name}": (key, name) for key in cameras for name in layout.STAT_NAMES}
    for row in _read_rows(
        root, lambda name: name in columns or name == layout.EPISODE_INDEX
    ).to_pylist():
        own: Statistics = {}
        for column, (key, name) in columns.items():
            if row.get(column) is not None:
                own.setdefault(key, {})[name] = np.array(row[column])
        found.append(own)
    return found


def _read_rows(root: Path, wanted: Callable[[str], bool]) -> pa.Table:
    """Return columns of `meta/episodes`, chosen by name."""
    paths = sorted(root.glob(layout.EPISODES_FILES))
    if not paths:
        raise ManipError(f"{root} has no episodes: no file matches {layout.EPISODES_FILES}")
    tables = [read_file(path, [*filter(wanted, column_names(path))]) for path in paths]
    return pa.concat_tables(tables, promote_options="permissive")
