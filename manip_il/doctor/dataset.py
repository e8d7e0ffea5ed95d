"""Content of a dataset's folder, read once; a damaged file does not keep the others from being read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import NUMBERS, Info, InvalidInfo, read_info, read_object
from manip_il.data.parquet_files import UNREADABLE, BadColumn, Shard, find_shards, floats, integers
from manip_il.doctor.finding import Finding, error
from manip_il.doctor.scan import F64, I64, Scan, concatenate, scan

_WHOLE = ("length", "dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")


@dataclass(frozen=True)
class Clips:
    """Places of one camera's episodes, one entry an episode: a video file, start and stop in it [s]."""

    files: list[str]
    starts: F64
    stops: F64


@dataclass(frozen=True)
class Episodes:
    """Readable rows of `meta/episodes`, one entry an episode. files: the data file that each one names."""

    index: I64
    length: I64
    start: I64
    stop: I64
    files: list[str]
    tasks: list[list[str]]
    clips: dict[str, Clips]  # camera column -> places

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True)
class Dataset:
    """Content of a folder. on_file is called after every data file, video and journal."""

    root: Path
    on_file: Callable[[], None] = field(default=lambda: None, compare=False)

    @property
    def info(self) -> Info | None:
        """Content of `meta/info.json`; None where it cannot be used."""
        return self._info if isinstance(self._info, Info) else None

    @property
    def info_problems(self) -> list[str]:
        """Lines that say why `meta/info.json` cannot be used."""
        return [] if isinstance(self._info, Info) else self._info.problems

    @cached_property
    def _info(self) -> Info | InvalidInfo:
        try:
            return read_info(self.root)
        except InvalidInfo as invalid:
            return invalid

    @property
    def is_ours(self) -> bool:
        """Whether this program wrote it."""
        return (self.root / layout.OURS).exists()

    @property
    def journals(self) -> Path:
        """Folder of the dataset's journals, beside it; it may be missing."""
        root = self.root.absolute()
        return root.with_name(f"{root.name}.journals")

    @cached_property
    def data_shards(self) -> list[Shard]:
        """Data files that LeRobot reads: all that match its pattern, whether or not an episode names them."""
        return find_shards(self.root, layout.DATA_FILES)

    @cached_property
    def episode_shards(self) -> list[Shard]:
        """Files of `meta/episodes`."""
        return find_shards(self.root, layout.EPISODES_FILES)

    @property
    def episodes(self) -> Episodes | None:
        """Readable rows of `meta/episodes`; None where there are none."""
        return self._episodes[0]

    @property
    def episode_findings(self) -> list[Finding]:
        """Damage behind the footers of `meta/episodes`: columns and pages."""
        return self._episodes[1]

    @cached_property
    def _episodes(self) -> tuple[Episodes | None, list[Finding]]:
        parts: list[Episodes] = []
        findings: list[Finding] = []
        for shard in self.episode_shards:
            if self.info is None or shard.problem:
                continue
            try:
                for table in shard.tables(rows=500):
                    parts.append(_read_episodes(table, self.info))
            except BadColumn as problem:
                findings.append(error(shard.name, str(problem)))
            except UNREADABLE as problem:
                findings.append(error(shard.name, f"cannot be read: {problem}"))
        return (concatenate(parts) if parts else None), findings

    @property
    def reads_all_episodes(self) -> bool:
        """Whether every row of `meta/episodes` can be read."""
        return not self.episode_findings and not any(shard.problem for shard in self.episode_shards)

    @property
    def knows_all_episodes(self) -> bool:
        """Whether `meta/episodes` can be read and holds as many episodes as `meta/info.json` counts."""
        if self.info is None or self.episodes is None:
            return False
        return self.reads_all_episodes and len(self.episodes) == self.info.episodes

    @cached_property
    def scan(self) -> Scan:
        """Result of reading all data files once."""
        if self.info is None:
            return Scan()
        quantiles: dict[str, F64] = {}
        for feature in self.info.of_dtype(*NUMBERS) if self.is_ours else []:
            rows = [self.statistic(feature.key, name) for name in layout.QUANTILES]
            if all(row is not None and len(row) == feature.size for row in rows):
                quantiles[feature.key] = np.array(rows)
        return scan(self.data_shards, self.info, quantiles, self.on_file)

    @property
    def reads_all_rows(self) -> bool:
        """Whether there are data files and each of them can be read to its end."""
        return bool(self.data_shards) and len(self.scan.readable) == len(self.data_shards)

    @cached_property
    def stats(self) -> dict[str, Any] | None:
        """Content of `meta/stats.json`; None where it cannot be read."""
        try:
            return read_object(self.root / layout.STATS)
        except (OSError, ValueError, RecursionError):
            return None

    def statistic(self, key: str, name: str) -> F64 | None:
        """Return a column's statistic in `meta/stats.json`, flat, (n,); None for all but finite numbers."""
        table: Any = (self.stats or {}).get(key)
        if not isinstance(table, dict) or name not in table:
            return None
        try:
            values = np.asarray(cast(dict[str, Any], table)[name], dtype=np.float64).reshape(-1)
        except (TypeError, ValueError, OverflowError):
            return None
        return values if np.isfinite(values).all() else None


def _read_episodes(table: pa.Table, info: Info) -> Episodes:
    length, start, stop, chunk, file = (integers(table, name) for name in _WHOLE)
    return Episodes(
        index=integers(table, layout.EPISODE_INDEX),
        length=length,
        start=start,
        stop=stop,
        files=[_file_name(info.data_path, *place) for place in zip(chunk, file, strict=True)],
        tasks=_texts(table),
        clips={feature.key: _read_clips(table, info, feature.key) for feature in info.of_dtype("video")},
    )


def _read_clips(table: pa.Table, info: Info, key: str) -> Clips:
    chunk, file = (integers(table, f"videos/{key}/{name}") for name in ("chunk_index", "file_index"))
    starts, stops = (floats(table, f"videos/{key}/{name}") for name in ("from_timestamp", "to_timestamp"))
    return Clips([_file_name(info.video_path, *place, key) for place in zip(chunk, file, strict=True)], starts, stops)


def _file_name(template: str, chunk: int, file: int, key: str = "") -> str:
    return template.format(chunk_index=int(chunk), file_index=int(file), video_key=key)


def _texts(table: pa.Table) -> list[list[str]]:
    if "tasks" not in table.column_names:
        raise BadColumn("has no column 'tasks'")
    rows = table.column("tasks").to_pylist()
    if not all(isinstance(row, list) and all(isinstance(text, str) for text in row) for row in rows):
        raise BadColumn("column 'tasks' does not hold lists of strings")
    return rows
