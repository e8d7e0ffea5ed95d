"""Import MCAP files as a LeRobot dataset: one episode per file, resampled to the dataset's rate, without gaps.

An episode lasts from the time when all topics have started to the time when the first one ends, by log time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from manip_il import checks
from manip_il.bridges.mcap.mapping import TASK, TEXT, Mapping, TopicSource
from manip_il.bridges.mcap.path import values_at
from manip_il.bridges.mcap.read import read_messages, read_pictures, read_topics
from manip_il.data.foxglove import NANOSECONDS, frame_times
from manip_il.data.lerobot_write import new_dataset
from manip_il.data.schema import exact_rate
from manip_il.errors import ManipError, MismatchError, nearest
from manip_il.mdp import I64
from manip_il.worlds.contract import plain_rate

Frame = dict[str, Any]  # column -> array or text, and `task`


def list_files(source: Path) -> list[Path]:
    """Return the MCAP file, or all those in a folder, sorted by name. Raises `ManipError` if there are none."""
    paths = sorted(path for path in source.glob("*.mcap") if not path.name.startswith("."))
    if not paths and not source.is_file():
        raise ManipError(f"{source} is not a file, and holds no *.mcap files")
    return paths or [source]


def import_files(paths: list[Path], root: Path, mapping: Mapping) -> Iterator[int]:
    """Write the files as a dataset, which appears at `root` when it is complete; yield each episode's frame count.

    All files are first read in a child process with limited memory and time. Raises `FolderExistsError` if `root` is
    not empty, `MismatchError` if shapes differ between files, and what `checks.in_child` and `read_frames` raise.
    """
    checks.in_child(str(paths[0]), _read_all, paths, mapping)
    features = _features(next(read_frames(paths[0], mapping)), mapping)
    with new_dataset(root, features, plain_rate(mapping.fps), mapping.robot_type) as writer:
        for path in paths:
            frames = list(read_frames(path, mapping))
            columns = {key: np.stack([frame[key] for frame in frames]) for key in features}
            texts = {key: columns[key].astype(object) for key in features if features[key]["dtype"] == TEXT}
            writer.add_columns(columns | texts, [frame[TASK] for frame in frames], {})
            yield len(frames)


def read_frames(path: Path, mapping: Mapping) -> Iterator[Frame]:
    """Yield a file's frames, resampled to the dataset's rate; pictures are read on demand.

    Raises `ManipError` naming file and topic if the file lacks something that the mapping names.
    """
    columns: dict[str, dict[str, TopicSource]] = {source.topic: {} for source in mapping.sources.values()}
    for key, source in mapping.sources.items():
        columns[source.topic][key] = source
    found: dict[str, dict[int, Any]] = {key: {} for key in mapping.sources}
    for topic, stamp, content in read_messages(path, columns):
        for key, source in columns[topic].items():  # if stamps are equal, the last message counts
            where = f"{path}, topic {topic}, {key} at {stamp} ns"
            found[key][stamp] = None if source.is_camera else _value(where, source, content)
    stamps: dict[str, I64] = {}
    for key, source in mapping.sources.items():
        stamps[source.topic] = np.array(list(found[key]), np.int64)
        if not found[key]:
            topics = read_topics(path)
            known = f"{nearest(source.topic, topics)}; its topics: {', '.join(topics)}"
            raise ManipError(f"{path} has no messages of {source.topic}{known}")
    times = _times(path, stamps, exact_rate(mapping.fps))
    rows: dict[str, Any] = {TASK: [mapping.task] * len(times)}
    for key, source in mapping.sources.items():
        where = f"{path}, topic {source.topic}, {key}"
        chosen = stamps[source.topic][pick(where, source, stamps[source.topic], times)].tolist()
        rows[key] = read_pictures(path, source.topic, chosen) if source.is_camera else map(found[key].get, chosen)
    for values in zip(*rows.values(), strict=True):
        yield dict(zip(rows, values, strict=True))


def pick(where: str, source: TopicSource, stamps: I64, times: I64) -> I64:
    """Return, for each frame time in `times`, (T,), the index of its message in `stamps`, (N,).

    Both are ascending [ns], and no frame is before the first message. Raises `ManipError` with `where`, the time of
    the gap and the tolerance if a frame's message is farther away in time than the tolerance.
    """
    chosen = np.searchsorted(stamps, times, side="right") - 1
    if source.resample == "nearest":
        after = np.minimum(chosen + 1, len(stamps) - 1)
        chosen = np.where(stamps[after] - times < times - stamps[chosen], after, chosen)
    far = np.abs(times - stamps[chosen]) > source.tolerance * NANOSECONDS
    if far.any():
        frame = int(np.argmax(far))
        place = f"{(times[frame] - times[0]) / NANOSECONDS:g} s (stamp {times[frame]} ns, frame {frame})"
        remedy = "between frame and message: raise the tolerance in the mapping, or leave out this file"
        raise ManipError(f"{where}: a gap at {place}; {source.resample} allows {source.tolerance:g} s {remedy}")
    return chosen


def _read_all(paths: list[Path], mapping: Mapping) -> None:
    """Read all files as an import does. Raises `MismatchError` unless all have the same shapes."""
    wanted: dict[str, Any] = {}
    for path in paths:
        checks.opening(str(path))
        for frame in read_frames(path, mapping):
            shapes = {key: np.shape(value) for key, value in frame.items()}
            wanted = wanted or shapes
            for key, shape in shapes.items():
                if shape != wanted[key]:
                    raise MismatchError(f"the shape of {key!r}", str(path), shape, str(paths[0]), wanted[key])


def _features(frame: Frame, mapping: Mapping) -> dict[str, dict[str, Any]]:
    """Return LeRobot's table of features."""
    features: dict[str, dict[str, Any]] = {}
    for key, source in mapping.features.items():
        dtype = source.dtype if not source.is_camera else "video" if source.video else "image"
        names = ["height", "width", "channels"] if source.is_camera else source.names
        features[key] = {"dtype": dtype, "shape": np.shape(frame[key]) or (1,), "names": names}
    return features


def _times(path: Path, stamps: dict[str, I64], rate: Fraction) -> I64:
    """Return the frames' times [ns], (T,), from the latest first stamp to the earliest last one."""
    last_to_start = max(stamps, key=lambda topic: stamps[topic][0])
    first_to_end = min(stamps, key=lambda topic: stamps[topic][-1])
    start, end = int(stamps[last_to_start][0]), int(stamps[first_to_end][-1])
    if end < start:
        late = f"{first_to_end} ends {(start - end) / NANOSECONDS:g} s before {last_to_start} starts"
        raise ManipError(f"{path}: {late}; expected topics that overlap in time")
    return start + np.array(frame_times(math.ceil((end - start + 1) * rate / NANOSECONDS), rate), np.int64)


def _value(where: str, source: TopicSource, content: Any) -> Any:
    """Return a column's text or array (*shape) from a message. Raises `ManipError` for values that do not fit."""
    try:
        values = [one for path in source.paths for one in values_at(path, content)]
        if source.width not in (None, len(values)):
            raise ValueError(f"the message has {len(values)} values; expected {source.width}")
        if not all(isinstance(one, str if source.dtype == TEXT else int | float) for one in values):
            raise ValueError(f"the message has {checks.shorten(values)}; expected values of type {source.dtype}")
        if source.dtype == TEXT:
            return checks.text("the message", values[0], len(values[0]))
        given = np.array(values, object)
        with np.errstate(over="ignore"):  # the next line checks for infinity
            numbers = given.astype(source.dtype)
        if not np.isfinite(numbers).all() if numbers.dtype.kind == "f" else (numbers != given).any():
            raise ValueError(f"the message has {checks.shorten(values)}; expected finite {source.dtype} numbers")
        return numbers.reshape(source.shape or -1)
    except (ManipError, OverflowError, ValueError) as error:
        raise ManipError(f"{where}: {error}") from error
