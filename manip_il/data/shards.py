"""Parquet files of any dataset: footers and columns are checked as they are read, and what is wrong is named."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.parquet_limits import check_parquet

MAGIC = b"PAR1"
NO_FOOTER = "has no footer: its writer died before it closed the file, or the file was cut"
_ROWS = 16_384  # held at once
UNREADABLE = (OSError, pa.ArrowException, ValueError, MemoryError)  # ArrowInvalid and its like are ValueErrors too


class BadColumn(ValueError):
    """A column that is not what its dataset says; the message says how."""


@dataclass(frozen=True)
class Shard:
    """One parquet file. problem: why it cannot be read; then it has no rows and no schema."""

    name: str  # in the dataset
    path: Path
    problem: str = ""
    rows: int = 0
    schema: pa.Schema | None = None

    @property
    def columns(self) -> list[str]:
        """Names of its columns."""
        return list(self.schema.names) if self.schema else []

    def tables(self, columns: Sequence[str] | None = None, rows: int = _ROWS) -> Iterator[pa.Table]:
        """Yield the rows in order, about `rows` at a time. Raises one of `UNREADABLE`.

        Checksums of pages are compared.
        """
        with pq.ParquetFile(self.path, page_checksum_verification=True) as file:
            groups: list[int] = []
            held = 0
            for group in range(file.num_row_groups):
                groups.append(group)
                held += file.metadata.row_group(group).num_rows
                if held >= rows or group == file.num_row_groups - 1:
                    yield file.read_row_groups(groups, columns=columns, use_threads=False)
                    groups, held = [], 0

    def batches(self, column: str, rows: int) -> Iterator[pa.Array]:
        """Yield one column's values, (T,) of at most `rows` at a time: pictures need not fit in memory."""
        with pq.ParquetFile(self.path, page_checksum_verification=True) as file:
            for batch in file.iter_batches(rows, columns=[column], use_threads=False):
                yield batch.column(0)


def find_shards(root: Path, pattern: str) -> list[Shard]:
    """Return every parquet file that matches, in LeRobot's order; none of them has to be readable."""
    paths = sorted(path for path in root.glob(pattern) if path.is_file())
    return [open_shard(path.relative_to(root).as_posix(), path) for path in paths]


def open_shard(name: str, path: Path) -> Shard:
    """Return the file with its footer read."""
    try:
        with path.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            first = stream.read(4)
            stream.seek(max(0, size - 4))
            last = stream.read(4)
        if size == 0:
            return Shard(name, path, "is empty")
        if first != MAGIC:
            return Shard(name, path, "is not a parquet file")
        if last != MAGIC or size < 12:
            return Shard(name, path, NO_FOOTER)
        check_parquet([path])
        metadata = pq.read_metadata(path)
        return Shard(name, path, rows=metadata.num_rows, schema=metadata.schema.to_arrow_schema())
    except UNREADABLE as problem:
        return Shard(name, path, f"cannot be read: {problem}")


def read_tasks(root: Path) -> tuple[list[int], list[str]]:
    """Return numbers and names of a dataset's tasks. Raises one of `UNREADABLE`."""
    if not (root / layout.TASKS).is_file():
        raise FileNotFoundError(root / layout.TASKS)
    shard = open_shard(layout.TASKS, root / layout.TASKS)
    if shard.problem:
        raise BadColumn(shard.problem)
    table = pa.concat_tables(shard.tables())
    numbers = integers(table, layout.TASK_INDEX)
    names = [one.name for one in table.schema if pa.types.is_string(one.type) or pa.types.is_large_string(one.type)]
    if len(names) != 1:  # pandas names the index `task`, or leaves it without a name of its own
        raise BadColumn(f"has {len(names)} columns of text; expected the tasks' names in one")
    return numbers.tolist(), table.column(names[0]).to_pylist()


def to_array(column: pa.ChunkedArray | pa.Array, dtype: str, shape: Sequence[int]) -> NDArray[Any]:
    """Return rows as (T, numbers of a frame). Raises `BadColumn` where type, size or emptiness does not fit."""
    array: Any = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if isinstance(array, pa.ChunkedArray):  # what combining no chunk at all gives
        array = pa.concat_arrays(array.chunks) if array.num_chunks else pa.array([], array.type)
    rows, size = len(array), int(np.prod(shape, dtype=np.int64))
    while True:
        if isinstance(array.type, pa.BaseExtensionType):
            array = array.storage
        if array.null_count:
            raise BadColumn(f"holds {array.null_count:,} missing values")
        if not _is_list(array.type):
            break
        array = array.flatten()
    if str(_numpy_type(array.type)) != dtype:
        raise BadColumn(f"is {array.type} in the file; info.json says {dtype}")
    if len(array) != rows * size:
        raise BadColumn(f"holds {len(array):,} numbers in {rows:,} rows; info.json says shape {list(shape)}")
    return array.to_numpy(zero_copy_only=False).reshape(rows, size)


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


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _numpy_type(kind: pa.DataType) -> Any:
    try:
        return np.dtype(kind.to_pandas_dtype())
    except (NotImplementedError, TypeError):
        return kind
