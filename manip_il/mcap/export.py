"""Export any LeRobot v3.0 dataset as MCAP: one file an episode, one topic a column, every number bit for bit.

Joint-like columns become `foxglove.JointStates`, other numbers LeRobot's scalars, pictures `foxglove.RawImage` as
decoded, text `foxglove.Log`. `mapping.yaml` beside the files is what an import needs to make the dataset again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from manip_il.data import foxglove
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES, Feature, Info, read_info
from manip_il.errors import ManipError
from manip_il.mcap.mapping import TASK, TEXT, Mapping, Source
from manip_il.mdp import require_finite

MAPPING = "mapping.yaml"
_TASK_TOPIC = "/task"
_HEADER = """\
# manip-il mcap import FOLDER NEW_DATASET --mapping=FOLDER/mapping.yaml recreates the dataset.
# Pictures are kept as they are (video: false); with video: true they are re-encoded, with loss.
"""
_JOINTS = (s.STATE, s.ACTION, s.EXECUTED_ACTION)
_TOLERANCE = 0.25  # of a frame: our own stamps are exact
_BATCH = 64  # encoded pictures held at a time


def open_source(root: Path) -> Info:
    """Return a dataset's description. Raises `ManipError` for no dataset, and for a column that is not exported."""
    info = read_info(root)
    for feature in _columns(info):
        is_depth = feature.details.get("is_depth_map") or feature.details.get("video.is_depth_map")
        if is_depth or feature.dtype not in (*NUMBERS, TEXT, *PICTURES):
            kind = "a depth map" if is_depth else feature.dtype
            raise ManipError(f"{root}: column {feature.key!r} is {kind}, which is not exported; remove it first")
    return info


def export_dataset(root: Path, info: Info, folder: Path) -> Iterator[Path]:
    """Write every episode to `folder/episode_<index>.mcap` and yield its path, then write the mapping.

    info: as `open_source` gives it. The same dataset gives the same bytes. Raises `NotFiniteError` for a number that
    JSON has not, and what `Dataset.columns` raises.
    """
    columns = _columns(info)
    numbers = [one.key for one in columns if one.dtype not in PICTURES]
    dataset = Dataset.open(root)
    table = dataset.columns([*numbers, layout.EPISODE_INDEX, layout.TASK_INDEX])
    for key in numbers:
        require_finite(f"{root}, column {key!r}", table[key])
    index, texts = table[layout.EPISODE_INDEX], dataset.tasks
    if missing := set(table[layout.TASK_INDEX].tolist()) - set(texts):
        raise ManipError(f"{root}: rows have the task {min(missing)}, which {layout.TASKS} does not hold as text")
    cameras = {one.key: dataset.camera(one.key) for one in columns if one.dtype in PICTURES}
    starts = np.flatnonzero(np.diff(index, prepend=-1)).tolist()
    for start, stop in itertools.pairwise([*starts, len(index)]):
        episode = int(index[start])
        rows: dict[str, Any] = {key: table[key][start:stop] for key in numbers}
        rows |= {key: camera.rows(np.arange(start, stop)) for key, camera in cameras.items()}
        rows[TASK] = [texts[number] for number in table[layout.TASK_INDEX][start:stop].tolist()]
        path = folder / f"episode_{episode:06d}.mcap"
        about = {"info": (root / layout.INFO).read_text(encoding="utf-8"), "episode_index": str(episode)}
        _write(path, about, columns, rows, [foxglove.log_time(frame, int(info.fps)) for frame in range(stop - start)])
        yield path
    (folder / MAPPING).write_text(_HEADER + mapping_of(info).to_yaml(), encoding="utf-8")


def mapping_of(info: Info) -> Mapping:
    """Return the mapping by which an import makes the dataset again."""
    fps = int(info.fps)
    near = ("nearest", round(_TOLERANCE / fps, 6))
    features: dict[str, Source] = {}
    for one in _columns(info):
        if one.dtype in PICTURES:
            features[one.key] = Source(_topic(one.key), *near, video=False)
        else:
            path = "message" if one.dtype == TEXT else "joints[:].position" if _is_joints(one) else "scalars[:].value"
            features[one.key] = Source(_topic(one.key), *near, path, one.dtype, one.names, one.shape)
    return Mapping(fps, Source(_TASK_TOPIC, *near, "message"), features, info.robot or None)


def _columns(info: Info) -> list[Feature]:
    return [feature for key, feature in info.features.items() if key not in INDEX_FEATURES]


def _write(
    path: Path, about: dict[str, str], columns: Sequence[Feature], rows: dict[str, Any], times: foxglove.Times
) -> None:
    channels = [foxglove.texts(_TASK_TOPIC, TASK, rows[TASK], times)]
    channels += [_channel(column, rows[column.key], times) for column in columns]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="manip_il")
        writer.add_metadata("lerobot", about)
        foxglove.add_channels(writer, channels, times)
        writer.finish()


def _channel(column: Feature, values: Any, times: foxglove.Times) -> foxglove.Channel:
    topic = _topic(column.key)
    if column.dtype in PICTURES:
        return foxglove.images(topic, column.key, values, times)
    if column.dtype == TEXT:
        return foxglove.texts(topic, column.key, values.reshape(-1).tolist(), times)
    values = values.reshape(len(times), -1)
    if _is_joints(column):
        return foxglove.joint_states(topic, column.names, values, times)
    if values.dtype.kind == "b":
        values = values.astype(np.int64)
    return foxglove.scalars(topic, _labels(column), values.tolist())


def _is_joints(column: Feature) -> bool:
    names = column.names
    is_flat = isinstance(names, list) and all(isinstance(one, str) for one in names) and column.shape == (len(names),)
    return column.key in _JOINTS and is_flat and column.dtype.startswith("float")


def _labels(column: Feature) -> list[str]:
    """Return the names, where there is one for each value; else numbers, as LeRobot labels such a column."""
    names = column.names
    if isinstance(names, dict):  # {"motors": [...]}
        names = [name for group in names.values() for name in (group if isinstance(group, list) else [group])]
    if isinstance(names, list) and len(set(map(str, names))) == len(names) == column.size:
        return list(map(str, names))
    return [column.key] if column.size == 1 else [f"{column.key}_{number}" for number in range(column.size)]


def _topic(key: str) -> str:
    """Return a column's topic: a dot would part it in Foxglove's paths, and no column's name has a slash."""
    return "/" + key.replace(".", "/")
