"""Numbered parquet files that are appended to, one row group at a time."""

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
    """Numbered parquet files, one open at a time."""

    def __init__(self, folder: Path, template: str, schema: pa.Schema):
        self._folder, self._template, self.schema = folder, template, schema
        self._number = 0
        self._path = folder
        self._writer: pq.ParquetWriter | None = None
        self.rows = 0  # in the open file

    @property
    def size(self) -> int:
        """Bytes in the open file."""
        return self._path.stat().st_size if self._writer else 0

    @property
    def next_place(self) -> tuple[int, int]:
        """Chunk and file index of what is written next."""
        return layout.numbered(self._template, self._number)[1:]

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Append one row group; return the chunk and file index it went to."""
        name, chunk, file = layout.numbered(self._template, self._number)
        if self._writer is None:
            self._path = self._folder / name
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(
                self._path,
                self.schema,
                compression="snappy",
                use_dictionary=True,
                write_page_checksum=True,  # else a changed bit is read as another number
            )
        self._writer.write_table(table)
        self.rows += len(table)
        return chunk, file

    def close(self) -> None:
        """Close the open file, if any; the next write opens the next one."""
        if self._writer is not None:
            writer, self._writer = self._writer, None  # first: a full disk lets no file be closed twice
            writer.close()
            self._number += 1
            self.rows = 0


def to_table(columns: Mapping[str, NDArray[Any]], schema: pa.Schema) -> pa.Table:
    """Columns (T,) and (T, d) as an Arrow table, vectors as lists of fixed size."""
    arrays: list[pa.Array] = []
    for field in schema:
        values = np.ascontiguousarray(columns[field.name])
        if pa.types.is_fixed_size_list(field.type):
            flat = pa.array(values.reshape(-1), field.type.value_type)
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, field.type.list_size))
        else:
            arrays.append(pa.array(values, field.type))
    return pa.Table.from_arrays(arrays, schema=schema)
