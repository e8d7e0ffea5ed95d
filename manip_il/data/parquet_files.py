"""Parquet files of datasets: write numbered ones a row group at a time, read columns as numpy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import NUMBERS, Feature, reading
from manip_il.data.pictures import to_png


class ParquetFiles:
    """Numbered parquet files, one open at a time; a new one starts once the open one is full.

    group_rows: rows that a row group has at least, but for a file's last. A writer keeps a description of every row
    group in memory until the file is closed, so many small ones would cost more than the rows.
    """

    def __init__(self, folder: Path, template: str, schema: pa.Schema, group_rows: int = 1):
        self._folder, self._template, self.schema = folder, template, schema
        self._limit, self._group_rows = layout.DATA_FILES_SIZE_IN_MB * 2**20, group_rows
        self._number = 0
        self._path = folder
        self._writer: pq.ParquetWriter | None = None
        self._waiting: list[pa.Table] = []
        self._waiting_bytes = 0

    def next_place(self) -> tuple[int, int]:
        """Return the chunk and file index that the next rows go to."""
        written = self._path.stat().st_size if self._writer is not None else 0
        if written + self._waiting_bytes >= self._limit:
            self.close()
        return layout.numbered(self._template, self._number)[1:]

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Append rows; return the chunk and file index that they go to."""
        place = self.next_place()
        self._waiting.append(table)
        self._waiting_bytes += table.nbytes
        if sum(map(len, self._waiting)) >= self._group_rows:
            self._flush()
        return place

    def close(self) -> None:
        """Close the open file, if any; the next write opens the next one."""
        if self._waiting:
            self._flush()
        if self._writer is not None:
            writer, self._writer = self._writer, None  # first: a full disk lets no file be closed twice
            writer.close()
            self._number += 1

    def _flush(self) -> None:
        table = pa.concat_tables(self._waiting).combine_chunks()
        self._waiting, self._waiting_bytes = [], 0
        if self._writer is None:
            self._path = self._folder / layout.numbered(self._template, self._number)[0]
            self._path.parent.mkdir(parents=True, exist_ok=True)
            repeating: Any = [field.name for field in self.schema if not pa.types.is_nested(field.type)]
            self._writer = pq.ParquetWriter(
                *(self._path, self.schema),
                compression="snappy",
                use_dictionary=repeating,  # the numbers of a vector seldom do
                write_page_checksum=True,  # else a changed bit is read as another number
            )
        self._writer.write_table(table)


def to_table(columns: Mapping[str, NDArray[Any]], schema: pa.Schema) -> pa.Table:
    """Return columns (T,) and (T, ...) as an Arrow table: vectors as lists, pictures as PNG."""
    arrays: list[pa.Array] = []
    for field in schema:
        values = columns[field.name]
        if field.type == layout.PICTURE:
            arrays.append(pa.array([{"bytes": to_png(picture), "path": None} for picture in values], field.type))
        elif values.ndim > 2:
            arrays.append(pa.array(values.tolist(), field.type))
        elif values.ndim > 1:
            flat = pa.array(np.ascontiguousarray(values).reshape(-1), field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, values.shape[1]).cast(field.type))
        else:
            arrays.append(pa.array(values, field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def read_file(path: Path, columns: Sequence[str]) -> pa.Table:
    """Return columns of a file, those that it has. Raises `ManipError` if it is damaged."""
    with reading(path), pq.ParquetFile(path, page_checksum_verification=True) as file:
        # one thread: handing out pieces of one episode costs more than reading them
        return file.read(list(columns), use_threads=False).replace_schema_metadata(None)


def read_tasks(root: Path) -> dict[int, str]:
    """Return a dataset's tasks by their number; the column of texts is pandas' index, with a name or without."""
    path = root / layout.TASKS
    with reading(path):
        table = read_file(path, pq.read_schema(path).names)
        texts = [one.name for one in table.schema if one.type in (pa.string(), pa.large_string())]
        name = "task" if "task" in texts else texts[-1]  # pandas writes an index behind the columns
        return dict(zip(table.column(layout.TASK_INDEX).to_pylist(), table.column(name).to_pylist(), strict=True))


def to_numpy(column: pa.ChunkedArray, feature: Feature) -> NDArray[Any]:
    """Return a column, (T,) or (T, *shape), as its feature says; text as objects.

    Raises `ValueError` if values have another kind or shape, or some are missing.
    """
    array: Any = column.combine_chunks()
    is_vector = feature.size > 1
    while isinstance(array, pa.ExtensionArray | pa.ListArray | pa.FixedSizeListArray):
        array, is_vector = array.storage if isinstance(array, pa.ExtensionArray) else array.flatten(), True
    dtype = np.dtype(feature.dtype if feature.dtype in NUMBERS else object)
    try:  # files may hold numbers narrower
        values = array.to_numpy(zero_copy_only=False).astype(dtype, casting="same_kind", copy=False)
        return values.reshape(len(column), *feature.shape if is_vector else ())
    except (TypeError, ValueError) as error:
        what = f"{feature.dtype} of shape {list(feature.shape)}"
        raise ValueError(f"{feature.key!r} has no {what} in each of {len(column):,} rows: {error}") from error
