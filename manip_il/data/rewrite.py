"""Write a dataset anew with other numbers in some of its columns; pictures and all else stay as they are."""

from __future__ import annotations

import shutil
from array import array
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import new_folder
from manip_il.data.dataset import Dataset
from manip_il.data.parquet_files import integers, open_writer, to_table
from manip_il.data.statistics import RunningStats
from manip_il.errors import ManipError

Columns = Mapping[str, NDArray[Any]]


def rewrite_columns(
    source: Path, target: Path, columns: Iterator[Columns], about: Mapping[str, Any], *, replace: bool = False
) -> None:
    """Write `source` to `target` with these columns in place of its own, and their statistics; videos are copied.

    columns: of every episode in stored order, name -> (T,) or (T, d). about: the content of `meta/manip_il.json`.
    replace: as in `new_folder`. Raises `ManipError` for a dataset that cannot be read, or whose episodes have other
    lengths than the columns.
    """
    Dataset.open(source)
    with new_folder(target, replace=replace) as folder:
        shutil.copytree(source, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.parquet"))
        shutil.copy2(source / layout.TASKS, folder / layout.TASKS)
        with closing(_Statistics(folder)) as statistics:
            for path in sorted(source.glob(layout.DATA_FILES)):
                _rewrite_data(path, folder / path.relative_to(source), columns, statistics)
            for path in sorted(source.glob(layout.EPISODES_FILES)):
                _rewrite_episodes(path, folder / path.relative_to(source), statistics)
            stats = checks.read_json(source / layout.STATS, "a dataset's statistics")
            layout.write_json(folder / layout.STATS, stats | statistics.result())
        layout.write_json(folder / layout.OURS, about)


class _Statistics:
    """Statistics of rewritten columns, of every episode and in the end of all frames."""

    def __init__(self, folder: Path):
        self._running, self._at = RunningStats(folder), 0
        self._episodes = array("q")  # indices
        self._numbers: dict[str, array[float]] = {}  # column of meta/episodes -> of all episodes, one after the other

    def add(self, episode: int, columns: Columns) -> None:
        """Add an episode's columns, (T,) or (T, d)."""
        self._episodes.append(episode)
        for key, table in self._running.add(columns).items():
            for name, values in table.items():
                self._numbers.setdefault(f"stats/{key}/{name}", array("d")).extend(values)

    def replaced(self, path: Path, table: pa.Table) -> pa.Table:
        """Return the next rows of `meta/episodes` with the columns of statistics that they have."""
        first, self._at = self._at, self._at + len(table)
        if integers(table, layout.EPISODE_INDEX).tolist() != list(self._episodes[first : self._at]):
            raise ManipError(f"{path} lists other episodes than the data files hold; run `manip-il doctor`")
        for name in self._numbers.keys() & set(table.column_names):
            place, numbers = table.column_names.index(name), np.frombuffer(self._numbers[name])
            width = len(numbers) // len(self._episodes)
            values = numbers[first * width : self._at * width]
            column = pa.ListArray.from_arrays(np.arange(0, len(values) + 1, width, np.int32), values)
            field = table.schema.field(place)
            table = table.set_column(place, field, column.cast(field.type))
        return table

    def result(self) -> dict[str, dict[str, list[float]]]:
        """Return the statistics of all frames."""
        return self._running.result()

    def close(self) -> None:
        """Let go of the file of numbers."""
        self._running.close()


def _rewrite_data(path: Path, target: Path, columns: Iterator[Columns], statistics: _Statistics) -> None:
    """Write one data file, row group by row group."""
    with pq.ParquetFile(path, page_checksum_verification=True) as file, _new_file(target, file.schema_arrow) as writer:
        index = integers(file.read([layout.EPISODE_INDEX]), layout.EPISODE_INDEX)
        starts = np.flatnonzero(np.diff(index, prepend=-1)).tolist()
        fresh: list[Columns] = []
        for start, stop in zip(starts, [*starts[1:], len(index)], strict=True):
            own = next(columns)
            if any(len(values) != stop - start for values in own.values()):
                lengths = {name: len(values) for name, values in own.items()}
                raise ManipError(f"{path}: episode {index[start]} has {stop - start} frames, its new columns {lengths}")
            statistics.add(int(index[start]), own)
            fresh.append(own)
        joined = {name: np.concatenate([own[name] for own in fresh]) for name in fresh[0]} if fresh else {}
        at = 0
        for group in range(file.num_row_groups):
            table = file.read_row_group(group, use_threads=False)
            writer.write_table(
                _with_columns(table, {name: rows[at : at + len(table)] for name, rows in joined.items()})
            )
            at += len(table)


def _with_columns(table: pa.Table, columns: Columns) -> pa.Table:
    fields = pa.schema([table.schema.field(name) for name in columns])
    fresh = to_table(columns, fields)
    for name in columns:
        place = table.column_names.index(name)
        table = table.set_column(place, table.schema.field(place), fresh.column(name))
    return table


def _rewrite_episodes(path: Path, target: Path, statistics: _Statistics) -> None:
    """Write one file of `meta/episodes`, row group by row group."""
    with pq.ParquetFile(path, page_checksum_verification=True) as file, _new_file(target, file.schema_arrow) as writer:
        for group in range(file.num_row_groups):
            writer.write_table(statistics.replaced(path, file.read_row_group(group, use_threads=False)))


def _new_file(path: Path, schema: pa.Schema) -> pq.ParquetWriter:
    path.parent.mkdir(parents=True, exist_ok=True)
    return open_writer(path, schema)
