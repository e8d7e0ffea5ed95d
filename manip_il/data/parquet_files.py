"""Numbered parquet files that are appended to, a row group at a time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout


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
