"""Parquet files of datasets: write numbered ones a row group at a time, read checked columns as numpy arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.info import NUMBERS
from manip_il.data.pictures import to_png
from manip_il.errors import ManipError, UnknownName

MAGIC = b"PAR1"
NO_FOOTER = "has no footer: its writer died before it closed the file, or the file was cut"
_ROWS = 16_384  # held at once
_TASK_NAMES = ("task", "__index_level_0__")  # pandas' for an index with a name and for one without
UNREADABLE = (OSError, pa.ArrowException, ValueError, MemoryError)  # ArrowInvalid and its like are ValueErrors too


class ParquetFiles:
    """Numbered parquet files, one open at a time.

    group_rows: rows that a row group has at least, but for a file's last. A writer keeps a description of every row
    group in memory until the file is closed, so many small ones would cost more than the rows.
    """

    def __init__(self, folder: Path, template: str, schema: pa.Schema, group_rows: int = 1):
        self._folder, self._template, self.schema, self._group_rows = folder, template, schema, group_rows
        self._number = 0
        self._path = folder
        self._writer: pq.ParquetWriter | None = None
        self._waiting: list[pa.Table] = []
        self._waiting_rows = self._waiting_bytes = 0
        self.rows = 0  # in the open file, waiting ones too

    @property
    def size(self) -> int:
        """Bytes in the open file; rows that wait count as they are in memory."""
        written = self._path.stat().st_size if self._writer else 0
        return written + self._waiting_bytes

    @property
    def next_place(self) -> tuple[int, int]:
        """Chunk and file index of what is written next."""
        return layout.numbered(self._template, self._number)[1:]

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Append rows; return the chunk and file index that they go to."""
        self._waiting.append(table)
        self._waiting_rows += len(table)
        self._waiting_bytes += table.nbytes
        self.rows += len(table)
        if self._waiting_rows >= self._group_rows:
            self._flush()
        return self.next_place

    def close(self) -> None:
        """Close the open file, if any; the next write opens the next one."""
        if self._waiting:
            self._flush()
        if self._writer is not None:
            writer, self._writer = self._writer, None  # first: a full disk lets no file be closed twice
            writer.close()
            self._number += 1
            self.rows = 0

    def _flush(self) -> None:
        table, self._waiting = pa.concat_tables(self._waiting).combine_chunks(), []
        self._waiting_rows = self._waiting_bytes = 0
        if self._writer is None:
            self._path = self._folder / layout.numbered(self._template, self._number)[0]
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = open_writer(self._path, self.schema)
        self._writer.write_table(table)


def open_writer(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    """Return a writer with the settings that all our files have."""
    repeating: Any = [
        field.name for field in schema if not pa.types.is_nested(field.type)
    ]  # vectors' numbers seldom do
    checksums = True  # else a changed bit is read as another number
    return pq.ParquetWriter(path, schema, compression="snappy", use_dictionary=repeating, write_page_checksum=checksums)


def to_table(columns: Mapping[str, NDArray[Any]], schema: pa.Schema) -> pa.Table:
    """Return columns (T,) and (T, d) as an Arrow table, vectors as lists of fixed size, pictures as PNG."""
    arrays: list[pa.Array] = []
    for field in schema:
        if field.type == layout.PICTURE:
            rows = [{"bytes": to_png(picture), "path": None} for picture in columns[field.name]]
            arrays.append(pa.array(rows, field.type))
            continue
        values = np.ascontiguousarray(columns[field.name])
        if pa.types.is_fixed_size_list(field.type):
            flat = pa.array(values.reshape(-1), field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, field.type.list_size))
        else:
            arrays.append(pa.array(values, field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def read_file(path: Path, columns: list[str]) -> pa.Table:
    """Return columns of a file.

    Raises `ManipError` for one that is damaged, `UnknownName` for a missing column.
    """
    try:
        with open(checks.open_regular(path), "rb") as stream:
            # one thread: handing out pieces of one episode costs more than reading them
            table = pq.ParquetFile(stream).read(columns, use_threads=False)
    except UNREADABLE as error:
        raise ManipError(
            f"cannot read {path}: {checks.one_line(error)}; run `manip-il doctor` to see what is left"
        ) from error
    for name in columns:
        if name not in table.column_names:
            raise UnknownName(f"column in {path}", name, table.column_names)
    return table.replace_schema_metadata(None)


def to_numpy(column: pa.ChunkedArray, dtype: str, shape: Sequence[int], *, exact: bool = False) -> NDArray[Any]:
    """Return a column, (T,) or (T, *shape), as its feature says; text as objects.

    exact: the numbers must have the width that the feature says, too. Raises `BadColumn` if values have another kind or
    shape, or some are missing.
    """
    array: Any = column.combine_chunks()
    rows, size, nested = len(array), math.prod(shape), False
    while True:
        if isinstance(array.type, pa.BaseExtensionType):
            array = array.storage
        if array.null_count:
            raise BadColumn(f"holds {array.null_count:,} missing values")
        if not _is_list(array.type):
            break
        array, nested = array.flatten(), True
    found, wanted = _numpy_type(array.type), np.dtype(object if dtype not in NUMBERS else dtype)
    if found.kind != wanted.kind or (exact and found != wanted):
        raise BadColumn(f"is {array.type} in the file; info.json says {dtype}")
    if len(array) != rows * size:
        raise BadColumn(f"holds {len(array):,} numbers in {rows:,} rows; info.json says shape {list(shape)}")
    values = array.to_numpy(zero_copy_only=False)
    return values.reshape(rows, *shape) if nested or size > 1 else values


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind)


class BadColumn(ValueError):
    """A column that is not what its dataset says; the message says how."""


@dataclass(frozen=True)
class Shard:
    """One parquet file, which need not be readable: the doctor goes on to the next one, where `read_file` raises.

    columns: their names. problem: why it cannot be read; then it has no columns.
    """

    name: str  # in the dataset
    path: Path
    problem: str = ""
    columns: tuple[str, ...] = ()

    def tables(self, columns: Sequence[str] | None = None, rows: int = _ROWS) -> Iterator[pa.Table]:
        """Yield the rows in order, at most `rows` at a time. Raises one of `UNREADABLE`.

        Checksums of pages are compared.
        """
        with pq.ParquetFile(self.path, page_checksum_verification=True) as file:
            for batch in file.iter_batches(rows, columns=columns, use_threads=False):
                yield pa.Table.from_batches([batch])


def find_shards(root: Path, pattern: str) -> list[Shard]:
    """Return every parquet file that matches, in LeRobot's order; none of them has to be readable."""
    return [open_shard(path.relative_to(root).as_posix(), path) for path in sorted(root.glob(pattern))]


def open_shard(name: str, path: Path) -> Shard:
    """Return the file with its footer read."""
    try:
        with open(checks.open_regular(path), "rb") as stream:
            if (size := stream.seek(0, 2)) == 0:
                return Shard(name, path, "is empty")
            stream.seek(0)
            if stream.read(4) != MAGIC:
                return Shard(name, path, "is not a parquet file")
            stream.seek(size - 4)
            if stream.read(4) != MAGIC or size < 12:
                return Shard(name, path, NO_FOOTER)
            return Shard(name, path, columns=tuple(pq.read_schema(stream).names))
    except UNREADABLE as problem:
        return Shard(name, path, f"cannot be read: {problem}")


def read_tasks(root: Path) -> tuple[list[int], list[str]]:
    """Return numbers and names of a dataset's tasks. Raises one of `UNREADABLE`."""
    if not (root / layout.TASKS).exists():
        raise FileNotFoundError(root / layout.TASKS)
    shard = open_shard(layout.TASKS, root / layout.TASKS)
    if shard.problem:
        raise BadColumn(shard.problem)
    table = pa.concat_tables(shard.tables())
    numbers = integers(table, layout.TASK_INDEX)
    texts = [one.name for one in table.schema if pa.types.is_string(one.type) or pa.types.is_large_string(one.type)]
    names = [name for name in texts if name in _TASK_NAMES] or texts
    if len(names) != 1:
        raise BadColumn(f"has {len(texts)} columns of text; expected the tasks' names in one called task")
    return numbers.tolist(), table.column(names[0]).to_pylist()


def integers(table: pa.Table, name: str) -> NDArray[np.int64]:
    """Return a column of whole numbers, (T,). Raises `BadColumn` for a missing one, missing values or another type."""
    return _numbers(table, name, "integers", pa.types.is_integer).astype(np.int64)


def floats(table: pa.Table, name: str) -> NDArray[np.float64]:
    """Return a column of numbers, (T,). Raises `BadColumn` as `integers` does."""
    return _numbers(table, name, "numbers", pa.types.is_floating, pa.types.is_integer).astype(np.float64)


def _numbers(table: pa.Table, name: str, expected: str, *types: Callable[[pa.DataType], bool]) -> NDArray[Any]:
    if name not in table.column_names:
        raise BadColumn(f"has no column {name!r}")
    column = table.column(name)
    if column.null_count or not any(is_type(column.type) for is_type in types):
        found = f"{column.type} with {column.null_count} missing values"
        raise BadColumn(f"column {name!r} is {found}; expected {expected}")
    return column.to_numpy()


def _numpy_type(kind: pa.DataType) -> np.dtype[Any]:
    try:
        return np.dtype(kind.to_pandas_dtype())
    except (NotImplementedError, TypeError):
        return np.dtype("V")  # nothing that a feature can be
