"""A dataset folder as it is: read once and leniently, so that one broken file hides nothing of the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import NUMBERS, Info, InvalidInfo, read_info, read_object
from manip_il.data.shards import UNREADABLE, BadColumn, Shard, find_shards, floats, integers
from manip_il.doctor.finding import Finding, error
from manip_il.doctor.scan import Scan, scan
from manip_il.doctor.stored import stored_quantiles

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
_WHOLE = ("length", "dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")


@dataclass(frozen=True)
class Clips:
    """Where one camera's episodes lie: a file and times in it [s], one entry an episode."""

    files: list[str]
    starts: F64
    stops: F64


@dataclass(frozen=True)
class Episodes:
    """The readable rows of `meta/episodes`, one entry an episode. files: the data file that each one names."""

    index: I64
    length: I64
    start: I64
    stop: I64
    files: list[str]
    tasks: list[list[str]]
    clips: dict[str, Clips]  # camera column -> where

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True)
class Dataset:
    """What a folder holds. on_file is called after every file that takes a while to read."""

    root: Path
    on_file: Callable[[], None] = field(default=lambda: None, compare=False)

    @cached_property
    def _info(self) -> tuple[Info | None, list[str]]:
        try:
            return read_info(self.root), []
        except InvalidInfo as invalid:
            return None, invalid.problems

    @property
    def info(self) -> Info | None:
        """Content of `meta/info.json`; None where it cannot be used."""
        return self._info[0]

    @property
    def info_problems(self) -> list[str]:
        """Lines that say what is wrong with `meta/info.json`."""
        return self._info[1]

    @property
    def is_ours(self) -> bool:
        """Whether this program wrote it."""
        return (self.root / layout.OURS).exists()

    @property
    def journals(self) -> Path:
        """The folder of journals that stands beside it, if one does."""
        root = self.root.absolute()
        return root.with_name(f"{root.name}.journals")

    @cached_property
    def data_shards(self) -> list[Shard]:
        """The data files that LeRobot would read: all that match, whoever refers to them."""
        return find_shards(self.root, layout.DATA_FILES)

    @cached_property
    def episode_shards(self) -> list[Shard]:
        """The files of `meta/episodes`."""
        return find_shards(self.root, layout.EPISODES_FILES)

    @cached_property
    def episodes(self) -> Episodes | None:
        """None where no row can be read."""
        return self._episodes[0]

    @property
    def episode_findings(self) -> list[Finding]:
        """What is wrong with the content of files of `meta/episodes` whose footers are there."""
        return self._episodes[1]

    @property
    def knows_all_episodes(self) -> bool:
        """Whether `meta/episodes` can be read and holds as many as `meta/info.json` counts."""
        if self.info is None or self.episodes is None or self.episode_findings:
            return False
        return not any(shard.problem for shard in self.episode_shards) and len(self.episodes) == self.info.episodes

    @cached_property
    def stats(self) -> dict[str, Any] | None:
        """Content of `meta/stats.json`; None where it cannot be read."""
        try:
            return read_object(self.root / layout.STATS)
        except (OSError, ValueError, RecursionError):
            return None

    @cached_property
    def scan(self) -> Scan:
        """What one reading of all data files gives."""
        if self.info is None:
            return Scan()
        quantiles = stored_quantiles(self.stats, self.info.of_dtype(*NUMBERS)) if self.is_ours else {}
        return scan(self.data_shards, self.info, quantiles, self.on_file)

    @property
    def reads_all_rows(self) -> bool:
        """Whether there are data files and each of them can be read to its end."""
        return bool(self.data_shards) and len(self.scan.readable) == len(self.data_shards)

    @cached_property
    def _episodes(self) -> tuple[Episodes | None, list[Finding]]:
        info = self.info
        if info is None:
            return None, []
        parts: list[Episodes] = []
        findings: list[Finding] = []
        for shard in self.episode_shards:
            if shard.problem:
                continue
            try:
                parts.extend(_read_episodes(table, info) for table in shard.tables(rows=500))
            except BadColumn as problem:
                findings.append(error(shard.name, str(problem)))
            except UNREADABLE as problem:
                findings.append(error(shard.name, f"cannot be read: {problem}"))
        return (_join(parts) if parts else None), findings


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


def _join(parts: list[Episodes]) -> Episodes:
    def joined(name: str) -> I64:
        return np.concatenate([getattr(part, name) for part in parts])

    clips = {
        key: Clips(
            [file for part in parts for file in part.clips[key].files],
            np.concatenate([part.clips[key].starts for part in parts]),
            np.concatenate([part.clips[key].stops for part in parts]),
        )
        for key in parts[0].clips
    }
    files = [file for part in parts for file in part.files]
    tasks = [row for part in parts for row in part.tasks]
    return Episodes(joined("index"), joined("length"), joined("start"), joined("stop"), files, tasks, clips)
