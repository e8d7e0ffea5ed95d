"""Parquet files of datasets: write numbered ones a row group at a time, read checked columns as numpy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.parquet_limits import check_parquet
from manip_il.errors import ManipError, UnknownName


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
        self.rows = 0  # in the open file, waiting ones too

    @property
    def size(self) -> int:
        """Bytes in the open file; rows that wait count as they are in memory."""
        written = self._path.stat().st_size if self._writer else 0
        return written + sum(table.nbytes for table in self._waiting)

    @property
    def next_place(self) -> tuple[int, int]:
        """Chunk and file index of what is written next."""
        return layout.numbered(self._template, self._number)[1:]

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Append rows; return the chunk and file index that they go to."""
        self._waiting.append(table)
        self.rows += len(table)
        if sum(map(len, self._waiting)) >= self._group_rows:
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
        if self._writer is None:
            self._path = self._folder / layout.numbered(self._template, self._number)[0]
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(
                self._path,
                self.schema,
                compression="snappy",
                use_dictionary=True,
                write_page_checksum=True,  # else a changed bit is read as another number
            )
        self._writer.write_table(table)


def to_table(columns: Mapping[str, NDArray[Any]], schema: pa.Schema) -> pa.Table:
    """Return columns (T,) and (T, d) as an Arrow table, vectors as lists of fixed size."""
    arrays: list[pa.Array] = []
    for field in schema:
        values = np.ascontiguousarray(columns[field.name])
        if pa.types.is_fixed_size_list(field.type):
            flat = pa.array(values.reshape(-1), field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, field.type.list_size))
        else:
            arrays.append(pa.array(values, field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def check_files(root: Path, paths: list[Path], columns: list[str] | None) -> None:
    """Raise `ManipError` where files of a dataset cannot be read, or columns (None: all) unpack to too much."""
    try:
        check_parquet(paths, columns)
    except (OSError, ValueError, pa.ArrowException) as error:
        place = paths[0] if len(paths) == 1 else f"{root}/{paths[0].relative_to(root).parts[0]}"
        raise ManipError(f"cannot read {place}: {error}; run `manip-il doctor` to see what is left") from error


def read_file(path: Path, columns: list[str]) -> pa.Table:
    """Return columns of a file.

    Raises `ManipError` for one that is damaged or unpacks to too much, `UnknownName` for a missing column.
    """
    try:
        check_parquet([path], columns)
        # one thread: handing out pieces of one episode costs more than reading them
        table = pq.ParquetFile(path).read(columns, use_threads=False)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ManipError(f"cannot read {path}: {error}; run `manip-il doctor` to see what is left") from error
    for name in columns:
        if name not in table.column_names:
            raise UnknownName(f"column in {path}", name, table.column_names)
    return table.replace_schema_metadata(None)


def read_column(root: Path, name: str, table: pa.Table, feature: Mapping[str, Any]) -> NDArray[Any]:
    """Return a column, (T,) or (T, *shape), as `feature` says.

    Raises `ManipError` naming the dataset `root` where values have another kind or shape, or some are missing.
    """
    shape, dtype = tuple(feature["shape"]), feature["dtype"]
    column = table.column(name)
    try:
        values = _to_numpy(column, shape)
        kind = "O" if dtype == "string" else np.dtype(dtype).kind
    except (ValueError, TypeError, pa.ArrowException) as error:
        raise ManipError(f"{root}: column {name!r} is not {dtype} of shape {shape}: {error}") from error
    fits = values.shape[1:] == shape or (values.ndim == 1 and shape in ((1,), ()))  # a scalar may have no width
    if column.null_count or values.dtype.kind != kind or len(values) != len(column) or not fits:
        missing = f" with {column.null_count} missing" if column.null_count else ""
        holds = checks.shorten(str(column.type))
        raise ManipError(f"{root}: column {name!r} holds {holds}{missing}; expected {dtype} of shape {shape}")
    return values


def _to_numpy(column: pa.ChunkedArray, shape: Sequence[int]) -> NDArray[Any]:
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):  # what older versions give for no chunk at all
        array = pa.concat_arrays(array.chunks)
    length, nested = len(array), False
    while _is_list(array.type):
        array, nested = array.flatten(), True
    values = array.to_numpy(zero_copy_only=False)
    return values.reshape(length, *shape) if nested else values


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind)
