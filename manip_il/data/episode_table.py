"""The rows of `meta/episodes`: where each episode's frames are, what it is about, and what it drew.

Draws are this program's: text in a column of its own, one JSON object an episode, `{}` for nothing. LeRobot's merge
keeps the column, its split and delete drop it; every frame's `sim_state` has the draws all the same.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import Info, reading
from manip_il.data.parquet_files import read_file
from manip_il.data.statistics import Statistics
from manip_il.errors import ManipError

I64, F64 = NDArray[np.int64], NDArray[np.float64]


@dataclass(frozen=True)
class Clips:
    """Places of one camera's episodes, one entry an episode: a video file, and the start in it [s]."""

    files: list[str]
    starts: F64


@dataclass(frozen=True)
class EpisodeTable:
    """One entry an episode. drawn: by the index of the episode."""

    index: I64
    length: I64
    start: I64
    stop: I64
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
    with reading(root / "meta/episodes"):
        names = [[name for name in pq.read_schema(path).names if not name.startswith("stats/")] for path in paths]
        tables = [read_file(path, wanted) for path, wanted in zip(paths, names, strict=True)]
        table = pa.concat_tables(tables, promote_options="permissive")

        def numbers(name: str) -> I64:
            return table.column(name).cast(pa.int64()).to_numpy()

        def clips(key: str) -> Clips:
            places = zip(
                *(numbers(f"videos/{key}/{name}").tolist() for name in ("chunk_index", "file_index")), strict=True
            )
            files = [
                info.video_path.format(chunk_index=chunk, file_index=file, video_key=key) for chunk, file in places
            ]
            return Clips(files, table.column(f"videos/{key}/from_timestamp").to_numpy())

        index, none = numbers(layout.EPISODE_INDEX), [None] * len(table)
        drawn, tasks = (
            table.column(name).to_pylist() if name in table.column_names else none for name in (layout.DRAWN, "tasks")
        )
        return EpisodeTable(
            index=index,
            length=numbers("length"),
            start=numbers("dataset_from_index"),
            stop=numbers("dataset_to_index"),
            tasks=[texts or [] for texts in tasks],
            clips={feature.key: clips(feature.key) for feature in info.of_dtype("video")},
            drawn={number: json.loads(text or "{}") for number, text in zip(index.tolist(), drawn, strict=True)},
        )


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
