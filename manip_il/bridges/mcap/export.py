"""Export any LeRobot v3.0 dataset as MCAP: one file per episode, one topic per column, bit for bit.

States and actions become `foxglove.JointStates`, other numbers LeRobot's scalars, decoded pictures
`foxglove.RawImage`, text `foxglove.Log`. With `mapping.yaml`, next to the files, an import
recreates the dataset.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.writer import CompressionType, Writer

from manip_il.bridges.mcap.mapping import TASK, TEXT
from manip_il.data import foxglove
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.camera import Camera
from manip_il.data.dataset import Dataset
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES, Feature, Info
from manip_il.mdp import require_finite

MAPPING = "mapping.yaml"
_TASK_TOPIC = "/task"
_HEADER = """\
# manip-il data from-mcap FOLDER NEW_DATASET --mapping=FOLDER/mapping.yaml recreates the dataset.
# Pictures are kept as they are (video: false); with video: true they are re-encoded, with loss.
"""
_JOINTS = (s.STATE, s.ACTION, s.EXECUTED_ACTION)
_TOLERANCE = 0.25  # [frames]; our own stamps are exact
_BATCH = 64  # decoded pictures in memory at a time


def left_out(info: Info) -> list[str]:
    """Return the columns that are not exported: language, depth and other pictures that are not
    RGB.
    """
    exported = {*INDEX_FEATURES, *(column.key for column in _columns(info))}
    return [key for key in info.features if key not in exported]


def export_dataset(dataset: Dataset, folder: Path) -> Iterator[Path]:
    """Write every episode to `folder/episode_<index>.mcap`, yield its path, then write the mapping.

    The same dataset gives the same bytes. Raises `NotFiniteError` for NaN and infinity, which JSON
    lacks, and what `Dataset.columns` and `Dataset.camera` raise.
    """
    columns = _columns(dataset.info)
    cameras = {
        column.key: dataset.camera(column.key) for column in columns if column.dtype in PICTURES
    }
    numbers = [column.key for column in columns if column.key not in cameras]
    table = dataset.columns([*numbers, layout.TASK_INDEX])
    for key in numbers:
        require_finite(f"{dataset.root}, column {key!r}", table[key])
    texts = dataset.texts(table[layout.TASK_INDEX])
    episodes, rate = dataset.episodes, s.exact_rate(dataset.fps)
    for episode, start, stop in zip(
        episodes.index.tolist(), episodes.start, episodes.stop, strict=True
    ):
        times = foxglove.frame_times(stop - start, rate)
        channels: dict[str, foxglove.Channel] = {
            _TASK_TOPIC: (foxglove.texts(TASK), texts[start:stop])
        }
        for column in columns:
            key = column.key
            values = (
                _pictures(cameras[key], start, stop) if key in cameras else table[key][start:stop]
            )
            channels[_topic(key)] = _channel(column, values)
        path = folder / f"episode_{episode:06d}.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
            writer.start(profile="", library="manip_il")
            foxglove.add_channels(writer, channels, times)
            writer.finish()
        yield path
    mapping = yaml.safe_dump(
        _mapping_of(dataset.info), sort_keys=False, allow_unicode=True, default_flow_style=None
    )
    (folder / MAPPING).write_text(_HEADER + mapping, encoding="utf-8")


def _mapping_of(info: Info) -> dict[str, Any]:
    """Return the mapping with which an import recreates the dataset."""
    near = {"resample": "nearest", "tolerance": round(_TOLERANCE / info.fps, 6)}
    features: dict[str, Any] = {}
    for column in _columns(info):
        about: dict[str, Any] = {"video": False}
        if column.dtype not in PICTURES:
            numbers = "joints[:].position" if _is_joints(column) else "scalars[:].value"
            path = "message" if column.dtype == TEXT else numbers
            about = {
                "field": path,
                "dtype": column.dtype,
                "names": column.names,
                "shape": list(column.shape),
            }
        features[column.key] = {"topic": _topic(column.key), **about, **near}
    task = {"topic": _TASK_TOPIC, "field": "message", **near}
    return {"fps": info.fps, "robot_type": info.robot or None, "task": task, "features": features}


def _columns(info: Info) -> list[Feature]:
    """Return the columns that are exported."""
    kinds = (*NUMBERS, TEXT)
    columns = [
        column for column in info.features.values() if column.dtype in kinds or column.is_rgb
    ]
    return [column for column in columns if column.key not in INDEX_FEATURES]


def _channel(column: Feature, values: Any) -> foxglove.Channel:
    if column.dtype in PICTURES:
        return foxglove.images(column.key), values
    if column.dtype == TEXT:
        return foxglove.texts(column.key), values.reshape(-1).tolist()
    rows = values.reshape(len(values), -1).tolist()
    if _is_joints(column):
        return foxglove.joint_states(column.labels), rows
    unnamed = (
        [column.key]
        if column.size == 1
        else [f"{column.key}_{place}" for place in range(column.size)]
    )
    return foxglove.scalars(column.labels if column.names else unnamed), rows  # as in LeRobot


def _pictures(camera: Camera, start: int, stop: int) -> Iterator[foxglove.U8]:
    for first in range(start, stop, _BATCH):
        yield from camera.rows(np.arange(first, min(first + _BATCH, stop)))


def _is_joints(column: Feature) -> bool:
    return column.key in _JOINTS and column.dtype.startswith("float")


def _topic(key: str) -> str:
    """Return a column's topic, with slashes instead of dots, because Foxglove splits paths at
    dots.
    """
    return "/" + key.replace(".", "/")
