"""The rows of `meta/episodes`: where each episode's frames are, what it is about, and what it drew.

Draws are this program's: text in a column of its own, one JSON object an episode, `{}` for nothing. LeRobot's merge
keeps the column, its split and delete drop it; every frame's `sim_state` has the draws all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.info import Info
from manip_il.data.parquet_files import UNREADABLE, BadColumn, floats, integers, read_file
from manip_il.data.statistics import Statistics
from manip_il.errors import ManipError

I64, F64 = NDArray[np.int64], NDArray[np.float64]


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
    """Read all files of `meta/episodes`, but for statistics. Raises `ManipError` naming what cannot be read."""
    paths = sorted(root.glob(layout.EPISODES_FILES))
    if not paths:
        raise ManipError(f"{root} has no episodes: no file matches {layout.EPISODES_FILES}")
    try:
        names = [[name for name in pq.read_schema(path).names if not name.startswith("stats/")] for path in paths]
        tables = [read_file(path, wanted) for path, wanted in zip(paths, names, strict=True)]
        return _parse(pa.concat_tables(tables, promote_options="permissive"), info)
    except UNREADABLE as error:
        raise ManipError(f"cannot read meta/episodes of {root}: {checks.one_line(error)}") from error


def read_picture_statistics(root: Path, cameras: Sequence[str]) -> list[Statistics]:
    """Return the statistics of every episode's pictures, of cameras by their column, as far as there are any."""
    found: list[Statistics] = []
    for path in sorted(root.glob(layout.EPISODES_FILES)):
        names = {f"stats/{key}/{name}": (key, name) for key in cameras for name in layout.STAT_NAMES}
        here = [name for name in pq.read_schema(path).names if name in names]
        for row in read_file(path, [layout.EPISODE_INDEX, *here]).to_pylist():
            own: Statistics = {}
            for column in here:
                key, name = names[column]
                own.setdefault(key, {})[name] = np.array(row[column])
            found.append(own)
    return found


def _parse(table: pa.Table, info: Info) -> EpisodeTable:
    whole = ("length", "dataset_from_index", "dataset_to_index")
    length, start, stop = (integers(table, name) for name in whole)
    index = integers(table, layout.EPISODE_INDEX)
    tasks = table.column("tasks").to_pylist() if "tasks" in table.column_names else [[]] * len(table)
    cameras = [feature.key for feature in info.of_dtype("video")]
    return EpisodeTable(
        index=index,
        length=length,
        start=start,
        stop=stop,
        files=_files(table, "data", info.data_path),
        tasks=[[str(text) for text in texts or []] for texts in tasks],
        clips={key: _clips(table, info, key) for key in cameras},
        drawn=_drawn(table, index),
    )


def _files(table: pa.Table, prefix: str, template: str, key: str = "") -> list[str]:
    """The file that each row's `PREFIX/chunk_index` and `PREFIX/file_index` name."""
    places = zip(integers(table, f"{prefix}/chunk_index"), integers(table, f"{prefix}/file_index"), strict=True)
    return [template.format(chunk_index=int(chunk), file_index=int(file), video_key=key) for chunk, file in places]


def _clips(table: pa.Table, info: Info, key: str) -> Clips:
    starts, stops = (floats(table, f"videos/{key}/{name}") for name in ("from_timestamp", "to_timestamp"))
    return Clips(_files(table, f"videos/{key}", info.video_path, key), starts, stops)


def _drawn(table: pa.Table, index: I64) -> dict[int, dict[str, Any]]:
    """What the episodes drew; none in datasets from before, and in rows merged with those of such a dataset."""
    if layout.DRAWN not in table.column_names:
        return {}
    found: dict[int, dict[str, Any]] = {}
    for number, text in zip(index.tolist(), table.column(layout.DRAWN).to_pylist(), strict=True):
        what = f"{layout.DRAWN} of episode {number}"
        try:
            found[number] = {} if text is None else checks.mapping(what, checks.parse_json(what, text))
        except ManipError as error:
            raise BadColumn(str(error)) from error
    return found
