"""Import MCAP files as a LeRobot dataset: one episode a file, resampled to the dataset's rate, gaps refused.

An episode lasts from the latest of its topics' first messages to the earliest of their last ones, by log time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.atomic import new_folder
from manip_il.data.foxglove import NANOSECONDS, log_time
from manip_il.errors import ManipError, MismatchError
from manip_il.mcap.mapping import TASK, TEXT, Camera, Mapping, Method, Values
from manip_il.mcap.read import Topics, read_pictures, read_topics

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
Column = list[str] | NDArray[Any]


@dataclass(frozen=True)
class Pick:
    """Messages of T frames: for each the one before, the one after, and the frame's place between them, 0 to 1."""

    left: I64
    right: I64  # equal to `left` where one message is taken as it is
    weight: F64

    def blend(self, values: NDArray[Any]) -> NDArray[Any]:
        """Interpolate values (N, ...) of the messages to values (T, ...) of the frames.

        A message that is taken as it is keeps every bit.
        """
        left, right = values[self.left], values[self.right]
        if (self.left == self.right).all():
            return left
        weight = self.weight.reshape(-1, *[1] * (values.ndim - 1))
        between = np.clip(left + (right - left) * weight, np.minimum(left, right), np.maximum(left, right))
        return np.where(weight == 0, left, between)

    def used(self) -> I64:
        """Return the numbers of the messages that are in some frame, ascending, (M,)."""
        return np.union1d(self.left, self.right)


@dataclass(frozen=True)
class Import:
    """One file's episode. columns: of numbers and text, T rows each, `task` among them."""

    path: Path
    columns: dict[str, Column]
    picks: dict[str, Pick]  # of all columns and pictures
    counts: dict[str, int]  # messages of every topic in the file
    used: dict[str, int]  # messages of every topic that are in a frame

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.columns[TASK])


def list_files(source: Path) -> list[Path]:
    """Return the MCAP file, or the folder's in the order of their names. Raises `ManipError` where there are none."""
    if source.is_dir():
        paths = sorted(path for path in source.glob("*.mcap") if not path.name.startswith("."))
        if not paths:
            raise ManipError(f"{source} holds no *.mcap files")
        return paths
    if not source.is_file():
        raise ManipError(f"no such file or folder: {source}")
    return [source]


def import_files(paths: list[Path], root: Path, mapping: Mapping) -> Iterator[Import]:
    """Write the files as a dataset that appears at `root` when all are in; yield each one's import as it is done.

    Each is read in a child process first, which is limited in memory and time. Raises `FolderExistsError` where `root`
    holds something, and what `checks.in_child`, `read_import` and `frames_of` raise.
    """
    done: list[Import] = []
    first = _checked_import(paths[0], mapping)
    features = features_of(mapping, first)
    from manip_il.data.lerobot_library import write_with_library  # imports torch

    def episodes() -> Iterator[Iterator[dict[str, Any]]]:
        for number, path in enumerate(paths):
            done.append(_checked_import(path, mapping) if number else first)
            yield frames_of(done[-1], mapping, features)

    with new_folder(root) as folder:
        work = folder / root.name  # LeRobot makes its folder itself
        with closing(write_with_library(work, mapping.fps, mapping.robot_type, features, episodes())) as written:
            for _ in written:
                yield done.pop()
        for path in list(work.iterdir()):
            path.rename(folder / path.name)
        work.rmdir()


def _checked_import(path: Path, mapping: Mapping) -> Import:
    checks.in_child(str(path), _read_all, path, mapping)
    return read_import(path, mapping)


def _read_all(path: Path, mapping: Mapping) -> None:
    """Read everything that an import takes of a file."""
    episode = read_import(path, mapping)
    for _ in frames_of(episode, mapping, features_of(mapping, episode)):
        pass


def read_import(path: Path, mapping: Mapping) -> Import:
    """Read and resample one file, all but its pictures.

    Raises `ManipError` naming file and topic for whatever the mapping asks for and the file does not give.
    """
    topics = read_topics(path, mapping)
    times = _times(path, topics, mapping.fps)
    columns: dict[str, Column] = {TASK: [str(mapping.task)] * len(times)}
    picks: dict[str, Pick] = {}
    sources = mapping.values | mapping.cameras
    for key, source in sources.items():
        who = f"{path}, topic {source.topic}"
        picks[key] = pick(who, source.resample, topics.stamps[source.topic], times, source.tolerance)
        if isinstance(source, Values):
            columns[key] = _column(f"{who}, {key}", source.dtype, topics.rows[key], picks[key])
    used = {
        topic: len(np.unique(np.concatenate([picks[key].used() for key, one in sources.items() if one.topic == topic])))
        for topic in mapping.topics
    }
    return Import(path, columns, picks, dict(topics.counts), used)


def features_of(mapping: Mapping, first: Import) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table, shapes that the mapping leaves open as the first file has them."""
    features: dict[str, dict[str, Any]] = {}
    for key, source in mapping.features.items():
        if isinstance(source, Camera):
            shape = next(read_pictures(first.path, source.topic, first.picks[key].left[:1])).shape
            dtype = "video" if source.video else "image"
            features[key] = {"dtype": dtype, "shape": shape, "names": ["height", "width", "channels"]}
        else:
            column = first.columns[key]
            shape = (1,) if isinstance(column, list) else source.shape or column.shape[1:]
            features[key] = {"dtype": source.dtype, "shape": shape, "names": source.names}
    return features


def frames_of(episode: Import, mapping: Mapping, features: dict[str, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield frames as LeRobot's writer takes them, pictures read as they are needed.

    Raises `MismatchError` where a column's width or a picture's size is not that of the first file.
    """
    cameras, picks = mapping.cameras, episode.picks
    pictures = {key: read_pictures(episode.path, one.topic, picks[key].left) for key, one in cameras.items()}
    columns: dict[str, Column] = {}
    for key, column in episode.columns.items():
        if not isinstance(column, list):
            width, wanted = column.shape[1], int(np.prod(features[key]["shape"]))
            if width != wanted:
                raise MismatchError(f"column {key!r}", str(episode.path), width, "the first file", f"{wanted} values")
            column = column.reshape(-1, *features[key]["shape"])
        columns[key] = column
    for number in range(episode.frames):
        frame: dict[str, Any] = {key: column[number] for key, column in columns.items()}
        for key, stream in pictures.items():
            frame[key] = next(stream)
            if frame[key].shape != (size := features[key]["shape"]):
                raise MismatchError(f"{key!r}", f"{episode.path}", frame[key].shape, "the first file", size)
        yield frame


def frame_times(start: int, end: int, fps: int) -> I64:
    """Return stamps [ns] of frames at `fps` from `start` on, none later than `end`, (T,)."""
    count = ((end - start + 1) * fps - 1) // NANOSECONDS + 1
    return np.array([start + log_time(frame, fps) for frame in range(count)], dtype=np.int64)


def pick(who: str, method: Method, stamps: I64, times: I64, tolerance: float) -> Pick:
    """Pick messages with `stamps` (N,) for frames at `times` (T,), both [ns] and ascending, `stamps` strictly.

    nearest: the one with the smallest distance in time, the earlier of two; at most `tolerance` [s] away.
    hold: the last one not later than the frame; at most `tolerance` old.
    interpolate: the two around the frame, at most `tolerance` apart; one alone where it has the frame's stamp.
    Raises `ManipError` with `who`, the gap's place and the tolerance for the first frame that has none.
    """
    limit = tolerance * NANOSECONDS
    before = np.searchsorted(stamps, times, side="right") - 1  # -1: none
    after = np.minimum(before + 1, len(stamps) - 1)
    left = np.maximum(before, 0)
    to_left, to_right = np.abs(times - stamps[left]), np.abs(stamps[after] - times)
    right = left
    if method == "nearest":
        left = right = np.where(to_left <= to_right, left, after)
        bad = np.minimum(to_left, to_right) > limit
    elif method == "hold":
        bad = (before < 0) | (to_left > limit)
    else:
        right = np.where(to_left == 0, left, after)
        bad = (before < 0) | (stamps[right] - stamps[left] > limit) | (stamps[right] < times)
    if bad.any():
        raise _gap(who, method, stamps, times, int(np.argmax(bad)), tolerance)
    span = np.maximum(stamps[right] - stamps[left], 1)
    return Pick(left, right, np.where(left == right, 0.0, to_left / span))


def _times(path: Path, topics: Topics, fps: int) -> I64:
    last_to_start = max(topics.stamps, key=lambda topic: topics.stamps[topic][0])
    first_to_end = min(topics.stamps, key=lambda topic: topics.stamps[topic][-1])
    start, end = int(topics.stamps[last_to_start][0]), int(topics.stamps[first_to_end][-1])
    if end < start:
        raise ManipError(
            f"{path}: {first_to_end} ends {(start - end) / NANOSECONDS:g} s before {last_to_start} starts; "
            "expected topics that overlap in time"
        )
    return frame_times(start, end, fps)


def _column(who: str, dtype: str, rows: list[list[Any]], picked: Pick) -> Column:
    """Return a column's T values. Raises `ManipError` for a number that the dtype cannot hold."""
    if dtype == TEXT:
        return [rows[number][0] for number in picked.left.tolist()]
    given, is_float = np.array(rows, object), dtype.startswith("float")
    try:
        with np.errstate(over="ignore"):  # which the next lines see
            values = given.astype(np.float64 if is_float else dtype)
            good = np.isfinite(values.astype(dtype)) if is_float else values == given
    except (OverflowError, ValueError) as error:
        raise ManipError(f"{who}: {error}; expected {dtype}") from error
    if not good.all():
        number = int(np.argwhere(~good.astype(bool))[0][0])
        raise ManipError(f"{who}: message {number} holds {rows[number]!r}; expected finite numbers of {dtype}")
    return picked.blend(values).astype(dtype)


def _gap(who: str, method: Method, stamps: I64, times: I64, frame: int, tolerance: float) -> ManipError:
    time = times[frame]
    around = [f"{(time - stamps[stamps <= time][-1]) / NANOSECONDS:g} s before"] if (stamps <= time).any() else []
    around += [f"{(stamps[stamps > time][0] - time) / NANOSECONDS:g} s after"] if (stamps > time).any() else []
    return ManipError(
        f"{who}: a gap at {(time - times[0]) / NANOSECONDS:g} s (stamp {time} ns, frame {frame}): "
        f"the messages next to it are {' and '.join(around)}, {method} allows {tolerance:g} s; "
        "raise its tolerance in the mapping, or leave out this file"
    )
