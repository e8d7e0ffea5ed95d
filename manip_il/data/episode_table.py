"""The rows of `meta/episodes`: where each episode's frames are, what it is about, and what it drew.

Draws are this program's: text in a column of its own, one JSON object an episode, `{}` for nothing. LeRobot's merge
keeps the column, its split and delete drop it; every frame's `sim_state` has the draws all the same.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.info import Info
from manip_il.data.parquet_files import BadColumn, Shard, find_shards, floats, integers

I64, F64 = NDArray[np.int64], NDArray[np.float64]
_WHOLE = ("length", "dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")
_ROWS = 500  # held at once


@dataclass(frozen=True)
class Clips:
    """Places of one camera's episodes, one entry an episode: a video file, start and stop in it [s]."""

    files: list[str]
    starts: F64
    stops: F64


@dataclass(frozen=True)
class EpisodeTable:
    """One entry an episode. files: the data file that each one names. drawn: by the index of the episode."""

    index: I64
    length: I64
    start: I64
    stop: I64
    files: list[str]
    tasks: list[list[str]]
    clips: dict[str, Clips]  # camera column -> places
    drawn: dict[int, dict[str, Any]] = field(default_factory=dict[int, dict[str, Any]])

    def __len__(self) -> int:
        return len(self.index)


def read_episode_table(root: Path, info: Info) -> EpisodeTable:
    """Read all files of `meta/episodes`. Raises one of `UNREADABLE`."""
    shards = find_shards(root, layout.EPISODES_FILES)
    if bad := next((shard for shard in shards if shard.problem), None):
        raise BadColumn(f"{bad.name} {bad.problem}")
    if not shards:
        raise BadColumn(f"no file matches {layout.EPISODES_FILES}")
    return concatenate([rows for shard in shards for rows in read_rows(shard, info)])


def read_rows(shard: Shard, info: Info) -> Iterable[EpisodeTable]:
    """Yield the rows of one file. Raises one of `UNREADABLE`."""
    wanted = [name for name in shard.columns if not name.startswith("stats/")]
    return (_parse(table, info) for table in shard.tables(wanted, _ROWS))


def concatenate(parts: Sequence[Any]) -> Any:
    """Join values of one type: arrays (T, ...), lists, tables of those by the same names, or dataclasses of them."""
    first = parts[0]
    if len(parts) == 1:
        return first
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    if isinstance(first, list):
        return [value for part in parts for value in part]
    if isinstance(first, dict):
        if all(part.keys() == first.keys() for part in parts):
            return {key: concatenate([part[key] for part in parts]) for key in first}
        return {key: value for part in parts for key, value in part.items()}
    return type(first)(**concatenate([vars(part) for part in parts]))


def drawn_text(drawn: Mapping[str, Any]) -> str:
    """Return an episode's draws, by the names of their ranges, as JSON."""
    return json.dumps(dict(drawn))


def parse_drawn(what: str, text: Any) -> dict[str, Any]:
    """Return the inverse of `drawn_text`; of no text nothing. Raises `ManipError` naming `what` for anything else."""
    if text is None:  # as in the rows of a dataset that was merged with one that has none
        return {}
    return dict(checks.mapping(what, checks.parse_json(what, checks.text(what, text))))


def summarise_drawn(drawn: Iterable[Mapping[str, Any]]) -> str:
    """Return the ranges that numbers were drawn from, and what was drawn of words; the names alone of anything else."""
    values: dict[str, list[Any]] = {}
    for one in drawn:
        for name, value in one.items():
            values.setdefault(name, []).append(value)
    return ", ".join(name + _span(found) for name, found in sorted(values.items()))


def _parse(table: pa.Table, info: Info) -> EpisodeTable:
    length, start, stop, chunk, file = (integers(table, name) for name in _WHOLE)
    index = integers(table, layout.EPISODE_INDEX)
    return EpisodeTable(
        index=index,
        length=length,
        start=start,
        stop=stop,
        files=[_file_name(info.data_path, *place) for place in zip(chunk, file, strict=True)],
        tasks=_texts(table),
        clips={feature.key: _clips(table, info, feature.key) for feature in info.of_dtype("video")},
        drawn=_drawn(table, index),
    )


def _clips(table: pa.Table, info: Info, key: str) -> Clips:
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


def _drawn(table: pa.Table, index: I64) -> dict[int, dict[str, Any]]:
    """What the episodes drew; none in datasets from before."""
    if layout.DRAWN not in table.column_names:
        return {}
    texts = zip(index.tolist(), table.column(layout.DRAWN).to_pylist(), strict=True)
    return {number: parse_drawn(f"{layout.DRAWN} of episode {number}", text) for number, text in texts}


def _span(values: list[Any]) -> str:
    if all(isinstance(value, str) for value in values):
        return f" {' or '.join(sorted(set(values)))}"
    if not all(isinstance(value, int | float) for value in values):
        return ""
    low, high = min(values), max(values)
    return f" {low:.3g}" if low == high else f" {low:.3g} to {high:.3g}"
