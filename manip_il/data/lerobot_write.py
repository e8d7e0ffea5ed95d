"""Write LeRobot v3.0 datasets with pyarrow and PyAV, episode by episode, in memory that does not grow.

LeRobot's own writer takes 80 to 160 ms an episode and loses all of them when it is killed; this one writes the same
files in a few milliseconds an episode, and the dataset is there whole or not at all. Tests read it with LeRobot.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Generator, Iterable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import new_folder, writing
from manip_il.data.episode_table import drawn_text
from manip_il.data.info import DatasetInfo
from manip_il.data.parquet_files import ParquetFiles, to_table
from manip_il.data.schema import RobotTaskSpec, fitted_columns
from manip_il.data.statistics import I64, RunningStats, picture_stats, pixel_counts
from manip_il.data.video import CameraFiles, CameraThreads, Clip, try_encoder
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError
from manip_il.mdp import Episode

_MIB = 1024 * 1024
_GROUP_ROWS = 1_000  # frames in a row group
_EPISODE_ROWS = 100  # rows of meta/episodes held before they are written
FORMAT = 1  # of meta/manip_il.json


def own_file(
    repo_id: str, spec: RobotTaskSpec, fingerprint: Mapping[str, Any], provenance: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the content of `meta/manip_il.json`."""
    ours = {"format": FORMAT, "repo_id": repo_id, "spec": spec.to_json(), "fingerprint": dict(fingerprint)}
    return ours | {"provenance": dict(provenance or {})}


@contextlib.contextmanager
def new_dataset(
    root: Path,
    spec: RobotTaskSpec,
    *,
    repo_id: str,
    fingerprint: Mapping[str, Any],
    video: VideoConfig | None = None,
    replace: bool = False,
    data_files_size_in_mb: float = layout.DATA_FILES_SIZE_IN_MB,
    video_files_size_in_mb: float = layout.VIDEO_FILES_SIZE_IN_MB,
) -> Generator[DatasetWriter]:
    """Give a writer that takes episodes; the dataset appears at `root` on leaving, after `finish`, whole and on disk.

    The same episodes in the same order give the same bytes, videos included. video: LeRobot's settings by default.
    replace: as in `new_folder`. Raises `FolderExistsError` where `root` holds something, `UsageError` for pictures or
    settings that the encoder refuses, both before anything is written; `ManipError` on leaving without `finish`.
    """
    video = video or VideoConfig()
    if spec.cameras and spec.video:
        try_encoder(video, spec.image_size, spec.fps)
    ours = own_file(repo_id, spec, fingerprint)
    with new_folder(root, replace=replace) as folder:
        writer = DatasetWriter(folder, root, spec, ours, video, (data_files_size_in_mb, video_files_size_in_mb))
        try:
            yield writer
        finally:
            writer.close()
        if not writer.finished:
            raise ManipError(f"{root} was not finished and has been removed")


def write_dataset(
    episodes: Iterable[Episode],
    root: Path,
    spec: RobotTaskSpec,
    *,
    repo_id: str,
    fingerprint: Mapping[str, Any],
    provenance: Mapping[str, Any] | None = None,
    data_files_size_in_mb: float = layout.DATA_FILES_SIZE_IN_MB,
) -> DatasetInfo:
    """Write the episodes, in order, by `new_dataset`. They are taken one by one and not kept.

    Raises what `new_dataset` and `DatasetWriter` raise.
    """
    with new_dataset(
        root, spec, repo_id=repo_id, fingerprint=fingerprint, data_files_size_in_mb=data_files_size_in_mb
    ) as writer:
        for episode in episodes:
            writer.add(episode)
        return writer.finish(provenance)


class DatasetWriter:
    """Writes a dataset's episodes as they come; made by `new_dataset`."""

    def __init__(
        self,
        folder: Path,
        root: Path,
        spec: RobotTaskSpec,
        ours: Mapping[str, Any],
        video: VideoConfig,
        file_sizes: tuple[float, float],
    ):
        self._folder, self._root, self._spec, self._ours, self._file_sizes = folder, root, spec, ours, file_sizes
        self._data = ParquetFiles(folder, layout.DATA_PATH, layout.data_schema(spec), _GROUP_ROWS)
        self._meta = ParquetFiles(folder, layout.EPISODES_PATH, layout.episodes_schema(spec))
        self._cameras = CameraThreads(
            {key: CameraFiles(folder, key, video, spec.fps, file_sizes[1]) for key in spec.image_keys if spec.video}
        )
        self._stats = RunningStats(folder)
        self._counts: dict[str, I64] = {}  # camera column -> pixels of all episodes
        self._encoding: deque[tuple[dict[str, Any], dict[str, Future[Clip]]]] = deque()
        self._rows: list[dict[str, Any]] = []
        self._tasks: dict[str, int] = {}  # text -> its number, in the order of the first episodes
        self._episodes = self._frames = self._success = self._success_at_end = 0
        self.finished = False

    def add(self, episode: Episode) -> None:
        """Append one episode. Its pictures are encoded in other threads and must not be changed any more.

        Raises what `schema.fitted_columns` raises for an episode that does not fit, `ManipError` where an episode,
        this one or one before it, cannot be written.
        """
        if self.finished:
            raise ManipError(f"{self._root} is finished: no episodes can be added")
        columns = fitted_columns(episode, self._spec)
        pictures = {key: columns.pop(key) for key in self._spec.image_keys}
        films, stills = (pictures, {}) if self._spec.video else ({}, pictures)
        task = checks.text("instruction", episode.instruction or self._spec.instruction)
        columns |= self._index_columns(len(episode), self._tasks.setdefault(task, len(self._tasks)))
        with _explained(self._root):
            row = self._write_data(columns | stills, len(episode), task) | _flat(self._stats.add(columns))
            row[layout.DRAWN] = drawn_text(episode.drawn)
            for key, frames in stills.items():
                row |= self._picture_columns(key, pixel_counts(frames), len(episode))
            self._encoding.append((row, self._cameras.write(films)))
            self._settle()
        self._episodes += 1
        self._frames += len(episode)
        self._success += episode.success
        self._success_at_end += episode.success_at_end

    def finish(self, provenance: Mapping[str, Any] | None = None) -> DatasetInfo:
        """Write everything that is written once a dataset. provenance: where the episodes came from.

        Raises `ManipError` if there was no episode, or something cannot be written.
        """
        if not self._episodes:
            raise ManipError("no episodes: there is no dataset to write")
        with _explained(self._root):
            videos = self._cameras.finish()
            self._settle()
            self._write_rows()
            self._data.close()
            self._meta.close()
            self._write_meta(videos, provenance or {})
        self.finished = True
        return DatasetInfo(
            root=self._root,
            robot=self._spec.robot,
            task=self._spec.task,
            instruction=self._spec.instruction,
            fps=self._spec.fps,
            episodes=self._episodes,
            frames=self._frames,
            success=self._success,
            success_at_end=self._success_at_end,
        )

    def wait(self) -> None:
        """Wait until every picture so far is encoded."""
        for _, clips in self._encoding:
            for clip in clips.values():
                clip.result()

    def close(self) -> None:
        """Close files and end threads, finished or not."""
        self._cameras.stop()
        for files in (self._data, self._meta, self._stats):
            with contextlib.suppress(OSError):  # a full disk was reported by `add` or `finish`
                files.close()

    def _index_columns(self, length: int, task: int) -> dict[str, NDArray[Any]]:
        frame = np.arange(length, dtype=np.int64)
        return {
            layout.TIMESTAMP: (frame / self._spec.fps).astype(np.float32),
            layout.FRAME_INDEX: frame,
            layout.EPISODE_INDEX: np.full(length, self._episodes, dtype=np.int64),
            layout.INDEX: frame + self._frames,
            layout.TASK_INDEX: np.full(length, task, dtype=np.int64),
        }

    def _write_data(self, columns: Mapping[str, NDArray[Any]], length: int, task: str) -> dict[str, Any]:
        """The episode's rows; returns the episode's row of meta/episodes without statistics."""
        # LeRobot's rule: a new file where this episode, at the file's size a frame so far, would fill it
        size, frames = self._data.size, self._data.rows
        if frames and size + size / frames * length >= self._file_sizes[0] * _MIB:
            self._data.close()
        chunk, file = self._data.write(to_table(columns, self._data.schema))
        return {
            layout.EPISODE_INDEX: self._episodes,
            "tasks": [task],
            "length": length,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + length,
        }

    def _settle(self) -> None:
        """Write rows of meta/episodes as far as their pictures are encoded."""
        while self._encoding and all(clip.done() for clip in self._encoding[0][1].values()):
            row, clips = self._encoding.popleft()
            for key, future in clips.items():
                clip = future.result()
                row |= self._clip_columns(key, clip)
                row |= self._picture_columns(key, clip.counts, clip.frames)
            self._rows.append(row)
            if len(self._rows) >= _EPISODE_ROWS:
                self._write_rows()

    def _clip_columns(self, key: str, clip: Clip) -> dict[str, Any]:
        return {
            f"videos/{key}/chunk_index": clip.chunk,
            f"videos/{key}/file_index": clip.file,
            f"videos/{key}/from_timestamp": clip.first / self._spec.fps,
            f"videos/{key}/to_timestamp": (clip.first + clip.frames) / self._spec.fps,
        }

    def _picture_columns(self, key: str, counts: I64, frames: int) -> dict[str, Any]:
        """Statistics of an episode's pictures from one camera; they count for the dataset's."""
        self._counts[key] = self._counts.get(key, 0) + counts
        return _flat({key: picture_stats(counts, frames)})

    def _write_rows(self) -> None:
        if not self._rows:
            return
        if self._meta.size >= self._file_sizes[0] * _MIB:
            self._meta.close()
        chunk, file = self._meta.next_place
        place = {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
        self._meta.write(pa.Table.from_pylist([row | place for row in self._rows], self._meta.schema))
        self._rows.clear()

    def _write_meta(self, videos: dict[str, dict[str, Any]], provenance: Mapping[str, Any]) -> None:
        info = layout.info_json(self._spec, self._episodes, self._frames, self._file_sizes, videos, len(self._tasks))
        layout.write_json(self._folder / layout.INFO, info)
        layout.write_json(self._folder / layout.OURS, {**self._ours, "provenance": dict(provenance)})
        table = layout.tasks_table(list(self._tasks))
        pq.write_table(table, self._folder / layout.TASKS, write_page_checksum=True)
        stats = self._stats.result() | {
            key: picture_stats(counts, self._frames) for key, counts in self._counts.items()
        }
        layout.write_json(self._folder / layout.STATS, {key: stats[key] for key in layout.all_features(self._spec)})


@contextlib.contextmanager
def _explained(root: Path) -> Generator[None]:
    try:
        with writing(root):
            yield
    except OSError as error:
        raise ManipError(f"cannot write {root}: {error.strerror or error}") from error


def _flat(stats: Mapping[str, Mapping[str, list[Any]]]) -> dict[str, list[Any]]:
    return {f"stats/{key}/{name}": values for key, table in stats.items() for name, values in table.items()}
