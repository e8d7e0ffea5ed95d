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
from manip_il.mcap.mapping import TASK, TEXT, Mapping, Method
from manip_il.mcap.read import read_pictures, read_topics

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
Frame = dict[str, Any]  # column -> array or text, and `task`


@dataclass(frozen=True)
class Import:
    """One file's episode. columns: of numbers and text, T rows each, `task` among them."""

    path: Path
    columns: dict[str, list[str] | NDArray[Any]]
    pictures: dict[str, I64]  # camera's column -> its message in each of T frames
    counts: dict[str, int]  # messages of every topic in the file
    used: dict[str, int]  # messages of every topic that are in a frame

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.columns[TASK])


def list_files(source: Path) -> list[Path]:
    """Return the MCAP file, or the folder's in the order of their names. Raises `ManipError` where there are none."""
    paths = sorted(path for path in source.glob("*.mcap") if not path.name.startswith("."))
    if not paths and not source.is_file():
        raise ManipError(f"{source} is no file, and holds no *.mcap files")
    return paths or [source]


def import_files(paths: list[Path], root: Path, mapping: Mapping) -> Iterator[Import]:
    """Write the files as a dataset that appears at `root` when all are in; yield each one's import as it is done.

    Each is read in a child process first, which is limited in memory and time. Raises `FolderExistsError` where `root`
    holds something, and what `checks.in_child`, `read_import` and `frames_of` raise.
    """
    done = [_checked_import(paths[0], mapping)]
    features = features_of(done[0], mapping)
    from manip_il.data.lerobot_library import write_with_library  # imports torch

    def episodes() -> Iterator[Iterator[Frame]]:
        for path in paths:
            if not done:
                done.append(_checked_import(path, mapping))
            yield frames_of(done[0], mapping, features)

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
    for _ in frames_of(episode, mapping, features_of(episode, mapping)):
        pass


def read_import(path: Path, mapping: Mapping) -> Import:
    """Read and resample one file, all but its pictures.

    Raises `ManipError` naming file and topic for whatever the mapping asks for and the file does not give.
    """
    counts, stamps, rows = read_topics(path, mapping)
    times = _times(path, stamps, mapping.fps)
    columns: dict[str, list[str] | NDArray[Any]] = {TASK: [str(mapping.task)] * len(times)}
    pictures: dict[str, I64] = {}
    used: dict[str, set[int]] = {}
    for key, source in mapping.sources.items():
        who = f"{path}, topic {source.topic}, {key}"
        left, right = pick(who, source.resample, stamps[source.topic], times, source.tolerance)
        used.setdefault(source.topic, set()).update(left.tolist(), right.tolist())
        if source.is_camera:
            pictures[key] = left
        elif source.dtype == TEXT:
            columns[key] = [rows[key][number][0] for number in left.tolist()]
        else:
            values = _numbers(who, rows[key], source.dtype)
            chosen = values[left] if source.resample != "interpolate" else blend(stamps[source.topic], values, times)
            columns[key] = chosen.astype(source.dtype).reshape(len(times), *(source.shape or values.shape[1:]))
    return Import(path, columns, pictures, dict(counts), {topic: len(numbers) for topic, numbers in used.items()})


def features_of(first: Import, mapping: Mapping) -> dict[str, dict[str, Any]]:
    """Return LeRobot's feature table, with the shapes that the first file has."""
    frame = next(frames_of(first, mapping, {}))
    features: dict[str, dict[str, Any]] = {}
    for key, source in mapping.features.items():
        shape, names = np.shape(frame[key]) or (1,), source.names
        if source.is_camera:
            names = ["height", "width", "channels"]
        dtype = source.dtype if not source.is_camera else "video" if source.video else "image"
        features[key] = {"dtype": dtype, "shape": shape, "names": names}
    return features


def frames_of(episode: Import, mapping: Mapping, features: dict[str, dict[str, Any]]) -> Iterator[Frame]:
    """Yield frames as LeRobot's writer takes them, pictures read as they are needed.

    Raises `MismatchError` if a column's or a picture's shape is not that in `features`.
    """
    topics = {key: source.topic for key, source in mapping.features.items()}
    pictures = {key: read_pictures(episode.path, topics[key], numbers) for key, numbers in episode.pictures.items()}
    for number in range(episode.frames):
        frame = {key: column[number] for key, column in episode.columns.items()}
        frame |= {key: next(stream) for key, stream in pictures.items()}
        for key, feature in features.items():
            if (shape := np.shape(frame[key]) or (1,)) != feature["shape"]:
                raise MismatchError(
                    f"the shape of {key!r}", str(episode.path), shape, "the first file", feature["shape"]
                )
        yield frame


def frame_times(start: int, end: int, fps: int) -> I64:
    """Return stamps [ns] of frames at `fps` from `start` on, none later than `end`, (T,)."""
    count = ((end - start + 1) * fps - 1) // NANOSECONDS + 1
    return np.array([start + log_time(frame, fps) for frame in range(count)], dtype=np.int64)


def pick(who: str, method: Method, stamps: I64, times: I64, tolerance: float) -> tuple[I64, I64]:
    """Pick messages with `stamps` (N,) for frames at `times` (T,), both [ns] and ascending, `stamps` strictly.

    Returns the numbers of the messages before and after each frame, (T,) each, equal where one alone is taken.

    nearest: the one with the smallest distance in time, the earlier of two; at most `tolerance` [s] away.
    hold: the last one not later than the frame; at most `tolerance` old.
    interpolate: the two around the frame, at most `tolerance` apart; one alone where it has the frame's stamp.
    Raises `ManipError` with `who`, the gap's place and the tolerance for the first frame that has none.
    """
    limit = tolerance * NANOSECONDS
    left = np.maximum(np.searchsorted(stamps, times, side="right") - 1, 0)
    right = np.minimum(np.searchsorted(stamps, times), len(stamps) - 1)
    before, after = times - stamps[left], stamps[right] - times  # negative where there is no such message
    if method == "nearest":
        left = right = np.where(before <= after, left, right)
        bad = np.abs(times - stamps[left]) > limit
    elif method == "hold":
        right = left
        bad = (before < 0) | (before > limit)
    else:
        bad = (before < 0) | (after < 0) | (before + after > limit)
    if bad.any():
        frame = int(np.argmax(bad))
        raise ManipError(
            f"{who}: a gap at {(times[frame] - times[0]) / NANOSECONDS:g} s (stamp {times[frame]} ns, frame {frame}); "
            f"{method} allows {tolerance:g} s: raise its tolerance in the mapping, or leave out this file"
        )
    return left, right


def blend(stamps: I64, values: NDArray[Any], times: I64) -> F64:
    """Interpolate values (N, width) of messages to frames, (T, width)."""
    places, found = (times - stamps[0]).astype(np.float64), (stamps - stamps[0]).astype(np.float64)
    return np.stack([np.interp(places, found, column) for column in values.T], axis=1)


def _times(path: Path, stamps: dict[str, I64], fps: int) -> I64:
    last_to_start = max(stamps, key=lambda topic: stamps[topic][0])
    first_to_end = min(stamps, key=lambda topic: stamps[topic][-1])
    start, end = int(stamps[last_to_start][0]), int(stamps[first_to_end][-1])
    if end < start:
        late = f"{first_to_end} ends {(start - end) / NANOSECONDS:g} s before {last_to_start} starts"
        raise ManipError(f"{path}: {late}; expected topics that overlap in time")
    return frame_times(start, end, fps)


def _numbers(who: str, rows: list[list[Any]], dtype: str) -> NDArray[Any]:
    """Return rows (N, width), floats as float64. Raises `ManipError` for a number that the dtype cannot hold."""
    given, is_float = np.array(rows, object), dtype.startswith("float")
    try:
        with np.errstate(over="ignore"):  # which the next line sees
            values = given.astype(np.float64 if is_float else dtype)
            good = np.isfinite(values.astype(dtype)) if is_float else (values == given).astype(bool)
    except (OverflowError, ValueError) as error:
        raise ManipError(f"{who}: {error}; expected {dtype}") from error
    if not good.all():
        number = int(np.argwhere(~good)[0][0])
        raise ManipError(f"{who}: message {number} holds {rows[number]}; expected finite numbers of {dtype}")
    return values
