"""Export any LeRobot v3.0 dataset as MCAP: one file an episode, one topic a column, every number bit for bit.

Joint-like columns become `foxglove.JointStates`, other numbers LeRobot's scalars, pictures `foxglove.RawImage` as
decoded, text `foxglove.Log`. `mapping.yaml` beside the files is what an import needs to make the dataset again.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import foxglove
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES
from manip_il.data.parquet_files import UNREADABLE, find_shards
from manip_il.errors import ManipError
from manip_il.mcap.mapping import TEXT, Camera, Mapping, Values
from manip_il.mcap.path import parse_path
from manip_il.mcap.read import decode_picture
from manip_il.mdp import require_finite

U8 = NDArray[np.uint8]

MAPPING = "mapping.yaml"
TASK_TOPIC = "/task"
_HEADER = """\
# manip-il mcap import FOLDER NEW_DATASET --mapping=FOLDER/mapping.yaml recreates the dataset.
# Pictures are kept as they are (video: false); with video: true they are re-encoded, with loss.
"""
_JOINTS = (s.STATE, s.ACTION, s.EXECUTED_ACTION)
_TOLERANCE = 0.25  # of a frame: our own stamps are exact
_BATCH = 64  # encoded pictures held at a time


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
        return [key for key, feature in self.features.items() if feature["dtype"] in PICTURES]


def open_source(root: Path) -> Source:
    """Open a dataset. Raises `ManipError` for a folder that is none, and for a column that cannot be exported."""
    Dataset.open(root)
    info = checks.read_json(root / layout.INFO, "a LeRobot dataset's description")
    features = {key: feature for key, feature in info["features"].items() if key not in INDEX_FEATURES}
    for key, feature in features.items():
        dtype, details = feature["dtype"], feature.get("info")
        if dtype not in (*NUMBERS, TEXT, *PICTURES):
            raise ManipError(f"{root}: column {key!r} is {dtype}, which is not exported; remove it first")
        is_depth = isinstance(details, dict) and (details.get("is_depth_map") or details.get("video.is_depth_map"))
        if dtype in PICTURES and is_depth:
            raise ManipError(f"{root}: column {key!r} is a depth map, which is not exported; remove it first")
    return Source(root, int(info["fps"]), info["robot_type"], features)


def export_dataset(source: Source, folder: Path) -> Iterator[Path]:
    """Write every episode to `folder/episode_<index>.mcap` and yield its path, then write the mapping.

    The same dataset gives the same bytes. Raises `NotFiniteError` for a number that JSON has not, and what
    `read_table` raises.
    """
    columns = [key for key in source.features if key not in source.cameras]
    dataset = Dataset.open(source.root)
    table = dataset.columns([*columns, layout.EPISODE_INDEX, layout.TASK_INDEX])
    for key in columns:
        require_finite(f"{source.root}, column {key!r}", table[key])
    index, task_index = table.pop(layout.EPISODE_INDEX), table.pop(layout.TASK_INDEX)
    tasks = _read_tasks(dataset, set(task_index.tolist()))
    stored = {
        key: stored_pictures(source.root, key) for key in source.cameras if source.features[key]["dtype"] == "image"
    }
    starts = np.flatnonzero(np.diff(index, prepend=-1)).tolist()
    for start, stop in itertools.pairwise([*starts, len(index)]):
        episode = int(index[start])
        rows: dict[str, Any] = {key: values[start:stop] for key, values in table.items()}
        rows |= {key: itertools.islice(pictures, stop - start) for key, pictures in stored.items()}
        rows |= {key: dataset.frames(key, dataset.rows_of(episode)) for key in source.cameras if key not in stored}
        path = folder / f"episode_{episode:06d}.mcap"
        _write(path, source, episode, [tasks[int(task)] for task in task_index[start:stop]], rows)
        yield path
    (folder / MAPPING).write_text(_HEADER + mapping_of(source).to_yaml(), encoding="utf-8")


def mapping_of(source: Source) -> Mapping:
    """Return the mapping by which an import makes the dataset again."""
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


def _write(path: Path, source: Source, episode: int, tasks: Sequence[str], rows: dict[str, Any]) -> None:
    times = [foxglove.log_time(frame, source.fps) for frame in range(len(tasks))]
    channels = [foxglove.texts(TASK_TOPIC, "task", tasks, times)]
    channels += [_channel(key, feature, rows[key], times) for key, feature in source.features.items()]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="manip_il")
        metadata = {
            "codebase_version": layout.VERSION,
            "fps": str(source.fps),
            "robot_type": source.robot_type or "",
            "episode_index": str(episode),
            "frames": str(len(tasks)),
            "tasks": json.dumps(list(dict.fromkeys(tasks)), ensure_ascii=False),
            "features": json.dumps(source.features, ensure_ascii=False),
        }
        writer.add_metadata("lerobot", metadata)
        foxglove.add_channels(writer, channels, times)
        writer.finish()


def _channel(key: str, feature: dict[str, Any], values: Any, times: foxglove.Times) -> foxglove.Channel:
    if feature["dtype"] in PICTURES:
        return foxglove.images(_topic(key), key, values, times)
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
    """Return the names, where there is one for each value; else numbers, as LeRobot labels such a column."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [group])]
    if isinstance(names, list) and len(set(map(str, names))) == len(names) == width:
        return list(map(str, names))
    return [key] if width == 1 else [f"{key}_{number}" for number in range(width)]


def _topic(key: str) -> str:
    """Return a column's topic: a dot would part it in Foxglove's paths, and no column's name has a slash."""
    return "/" + key.replace(".", "/")


def _read_tasks(dataset: Dataset, wanted: set[int]) -> dict[int, str]:
    tasks = dataset.tasks
    for number in sorted(wanted):
        if not isinstance(tasks.get(number), str):
            raise ManipError(f"{dataset.root}: rows have the task {number}, which {layout.TASKS} does not hold as text")
    return tasks


def stored_pictures(root: Path, key: str) -> Iterator[U8]:
    """Yield every picture of an `image` column, (height, width, 3), in stored order."""
    for shard in find_shards(root, layout.DATA_FILES):
        try:
            if shard.problem or key not in shard.columns:
                raise ValueError(f"it {shard.problem or 'has no such column'}")
            for batch in shard.batches(key, _BATCH):
                for cell in batch.to_pylist():
                    content = cell.get("bytes") if isinstance(cell, dict) else None
                    yield decode_picture(content if isinstance(content, bytes) else b"")
        except (*UNREADABLE, ManipError) as error:
            raise ManipError(f"cannot read the pictures {key!r} in {shard.path}: {error}") from error
