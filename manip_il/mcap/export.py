"""Any LeRobot v3.0 dataset as MCAP: one file an episode, one topic a column, every number bit for bit.

Joint-like columns become `foxglove.JointStates`, other numbers LeRobot's scalars, pictures `foxglove.RawImage` as
decoded, text `foxglove.Log`. `mapping.yaml` beside the files is what `mcap_import` needs to make the dataset again.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.lerobot_read import dataset_info, read_table
from manip_il.data.parquet_limits import check_parquet
from manip_il.errors import ManipError
from manip_il.mcap import foxglove
from manip_il.mcap.frames import DatasetFrames, is_depth
from manip_il.mcap.mapping import INDEX_COLUMNS, NUMBERS, TEXT, Camera, Mapping, Values
from manip_il.mcap.path import parse_path
from manip_il.mdp import require_finite

MAPPING = "mapping.yaml"
TASK_TOPIC = "/task"
_JOINTS = (s.STATE, s.ACTION, s.EXECUTED_ACTION)
_PICTURES = ("image", "video")
_TOLERANCE = 0.25  # of a frame: our own stamps are exact


@dataclass(frozen=True)
class Source:
    """The dataset that is exported. features: LeRobot's, without its index columns."""

    root: Path
    fps: int
    robot_type: str | None
    features: dict[str, dict[str, Any]]

    @property
    def cameras(self) -> list[str]:
        """Columns of pictures."""
        return [key for key, feature in self.features.items() if feature["dtype"] in _PICTURES]


def open_source(root: Path) -> Source:
    """Look at a dataset. Raises `ManipError` for what is none, or a column that MCAP gets no place for here."""
    dataset_info(root)
    info = checks.read_json(root / layout.INFO, "a LeRobot dataset's description")
    features = {key: feature for key, feature in info["features"].items() if key not in INDEX_COLUMNS}
    for key, feature in features.items():
        if feature["dtype"] not in (*NUMBERS, TEXT, *_PICTURES):
            raise ManipError(f"{root}: column {key!r} is {feature['dtype']}, which is not exported; remove it first")
        if feature["dtype"] in _PICTURES and is_depth(feature):
            raise ManipError(f"{root}: column {key!r} is a depth map, which is not exported; remove it first")
    return Source(root, int(info["fps"]), info["robot_type"], features)


def export_dataset(source: Source, folder: Path) -> Iterator[Path]:
    """Write every episode to `folder/episode_<index>.mcap` and yield its path, then write the mapping.

    The same dataset gives the same bytes. Raises `NotFiniteError` for a number that JSON has not, and what
    `read_table` raises.
    """
    columns = [key for key in source.features if key not in source.cameras]
    table = read_table(source.root, [*columns, layout.EPISODE_INDEX, layout.TASK_INDEX])
    for key in columns:
        require_finite(f"{source.root}, column {key!r}", table[key])
    index, task_index = table.pop(layout.EPISODE_INDEX), table.pop(layout.TASK_INDEX)
    tasks = _tasks(source.root)
    pictures = DatasetFrames(source.root, {key: source.features[key]["dtype"] for key in source.cameras})
    starts = np.flatnonzero(np.diff(index, prepend=-1)).tolist()
    for start, stop in itertools.pairwise([*starts, len(index)]):
        episode = int(index[start])
        rows = {key: values[start:stop] for key, values in table.items()}
        lines = [_task(source.root, tasks, int(task)) for task in task_index[start:stop]]
        frames = {key: pictures.read(key, episode, stop - start) for key in source.cameras}
        path = folder / f"episode_{episode:06d}.mcap"
        _write(path, source, episode, lines, rows, frames)
        yield path
    (folder / MAPPING).write_text(_HEADER + mapping_of(source).to_yaml(), encoding="utf-8")


_HEADER = """\
# manip-il mcap import FOLDER NEW_DATASET --mapping=FOLDER/mapping.yaml recreates the dataset.
# Pictures are kept as they are (video: false); with video: true they are re-encoded, with loss.
"""


def mapping_of(source: Source) -> Mapping:
    """Return the mapping that makes the dataset again from its export."""
    near = ("nearest", round(_TOLERANCE / source.fps, 6))
    features: dict[str, Values | Camera] = {}
    for key, feature in source.features.items():
        topic = _topic(key)
        if key in source.cameras:
            features[key] = Camera(topic, *near, video=False)
            continue
        path = "message" if feature["dtype"] == TEXT else "scalars[:].value"
        path = "joints[:].position" if _is_joints(key, feature) else path
        shape = tuple(feature["shape"])
        features[key] = Values(topic, *near, (parse_path(path),), feature["dtype"], feature.get("names"), shape)
    task = Values(TASK_TOPIC, *near, (parse_path("message"),), TEXT)
    return Mapping(source.fps, source.robot_type, task, features)


def _write(
    path: Path,
    source: Source,
    episode: int,
    tasks: Sequence[str],
    rows: dict[str, NDArray[Any]],
    frames: dict[str, Iterator[NDArray[np.uint8]]],
) -> None:
    times = [foxglove.log_time(frame, source.fps) for frame in range(len(tasks))]
    channels = [foxglove.texts(TASK_TOPIC, "task", tasks, times)]
    for key, feature in source.features.items():
        if key in frames:
            channels.append(foxglove.images(_topic(key), key, frames[key], times))
        else:
            channels.append(_channel(key, feature, rows[key], times))
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="manip_il")
        writer.add_metadata("lerobot", _metadata(source, episode, tasks))
        foxglove.add_channels(writer, channels, times)
        writer.finish()


def _metadata(source: Source, episode: int, tasks: Sequence[str]) -> dict[str, str]:
    return {
        "codebase_version": layout.VERSION,
        "fps": str(source.fps),
        "robot_type": source.robot_type or "",
        "episode_index": str(episode),
        "frames": str(len(tasks)),
        "tasks": json.dumps(list(dict.fromkeys(tasks)), ensure_ascii=False),
        "features": json.dumps(source.features, ensure_ascii=False),
    }


def _channel(key: str, feature: dict[str, Any], values: NDArray[Any], times: foxglove.Times) -> foxglove.Channel:
    if feature["dtype"] == TEXT:
        return foxglove.texts(_topic(key), key, values.reshape(-1).tolist(), times)
    values = values.reshape(len(times), -1)
    if _is_joints(key, feature):
        return foxglove.joint_states(_topic(key), feature["names"], values, times)
    if values.dtype.kind == "b":
        values = values.astype(np.int64)
    return foxglove.scalars(_topic(key), _labels(key, feature, values.shape[1]), values.tolist())


def _is_joints(key: str, feature: dict[str, Any]) -> bool:
    names, shape = feature.get("names"), list(feature["shape"])
    is_flat = isinstance(names, list) and all(isinstance(name, str) for name in names) and shape == [len(names)]
    return key in _JOINTS and is_flat and feature["dtype"].startswith("float")


def _labels(key: str, feature: dict[str, Any], width: int) -> list[str]:
    """The names, where there is one for each value; else numbered, as LeRobot labels such a column."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [group])]
    if isinstance(names, list) and len(set(map(str, names))) == len(names) == width:
        return list(map(str, names))
    return [key] if width == 1 else [f"{key}_{number}" for number in range(width)]


def _topic(key: str) -> str:
    """A dot would part a topic in Foxglove's message paths; no feature's name has a slash."""
    return "/" + key.replace(".", "/")


def _tasks(root: Path) -> dict[int, str]:
    try:
        check_parquet([root / layout.TASKS])
        table = pq.read_table(root / layout.TASKS, columns=[layout.TASK_INDEX, "task"]).to_pydict()
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ManipError(
            f"cannot read {root / layout.TASKS}: {error}; run `manip-il doctor` to see what is left"
        ) from error
    numbers, texts = table[layout.TASK_INDEX], table["task"]
    if not all(isinstance(number, int) for number in numbers):
        raise ManipError(f"{root / layout.TASKS}: column {layout.TASK_INDEX!r} holds values that are not whole numbers")
    return dict(zip(numbers, texts, strict=True))


def _task(root: Path, tasks: dict[int, str], number: int) -> str:
    if not isinstance(task := tasks.get(number), str):
        raise ManipError(f"{root}: rows have the task {number}, which {layout.TASKS} does not hold as text")
    return task
