"""Checks that files agree: `info.json`, episodes, tasks, statistics, rows, videos and our own columns."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.bridges.doctor.finding import Finding, journals_of, list_first, of_episodes, warning
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.camera import open_video
from manip_il.data.dataset import Dataset
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES, Feature, reading
from manip_il.data.parquet_files import column_names, read_file

_AXES = (["height", "width", "channels"], ["height", "width", "channel"], ["channels", "height", "width"])
_TOLERANCES = {"min": 1e-5, "max": 1e-5, "mean": 1e-4, "std": 2e-3}  # shares of the largest value
_OF_SPREAD = 0.05  # tolerance as a share of the standard deviation, which LeRobot computes in float32
_NOISE = 1e-5  # a spread of less than this share of the largest value is lost in float32, so it is not compared
_TEMPORARY = re.compile(r"\..*\.tmp|.*\.(partial|incomplete|ffconcat)|tmp[a-z0-9_]{8}|images|\.cache")
_LATE = 1e-4  # largest difference in time between a video frame and its row that LeRobot's reader accepts [s]


def check_leftovers(dataset: Dataset) -> Iterator[Finding]:
    """Check for leftovers of a recorder, writer or download that died."""
    for path in leftovers(dataset.root):
        name = path.relative_to(dataset.root.absolute().parent).as_posix()
        yield warning(name, "left by a recorder, writer or download that died")


def leftovers(root: Path) -> list[Path]:
    """Return unneeded temporary files and folders in a dataset and next to it."""
    root = root.absolute()
    inside = [path for path in [*root.iterdir(), *root.glob("meta/*")] if _TEMPORARY.fullmatch(path.name)]
    beside = root.parent.glob(f".{root.name}.*partial")
    return sorted(path for path in [*inside, *beside] if any(one.is_file() for one in [path, *path.rglob("*")]))


def check_info(dataset: Dataset) -> Iterator[Finding]:
    """Check that `meta/info.json` has every column, and cameras with names and shapes that LeRobot can train on."""
    for feature in dataset.info.of_dtype(*PICTURES):
        shape, names = list(feature.shape), feature.names
        if names not in _AXES or len(shape) != 3 or shape[0 if names[0] == "channels" else 2] not in (1, 3):
            text = f"a camera of shape {shape} with names {names}, on which LeRobot cannot train"
            remedy = 'set [height, width, 3] and ["height", "width", "channels"] there'
            some_train = isinstance(names, list) and names[:2] == ["height", "width"]
            yield Finding(f"{layout.INFO}: {feature.key}", text, remedy, is_error=not some_train)
    wanted = {key for key, feature in dataset.features.items() if feature.dtype != "video"} | {*INDEX_FEATURES}
    for path in dataset.data_files:
        if odd := sorted(wanted ^ {*column_names(path)}):
            text = f"differs from {layout.INFO} in columns, so LeRobot cannot load it: {list_first(odd)}"
            yield Finding(path.relative_to(dataset.root).as_posix(), text)


def check_rows(dataset: Dataset) -> Iterator[Finding]:
    """Check that episodes are contiguous and numbered from 0, and that rows have matching indices and timestamps."""
    table = dataset.episodes
    tasks = dataset.tasks
    info = dataset.info
    ends = np.cumsum(table.length)
    frame = np.concatenate([np.arange(length) for length in table.length])
    columns = {key: dataset.columns([key])[key].reshape(-1) for key in INDEX_FEATURES}
    for place, found, wanted in (
        (f"{layout.INFO}: total_episodes", np.array([info.episodes]), np.array([len(table)])),
        (f"{layout.INFO}: total_tasks", np.array([len(tasks) if info.tasks is None else info.tasks]), [len(tasks)]),
        ("meta/episodes: episode_index", table.index, np.arange(len(table))),
        ("meta/episodes: dataset_from_index", table.start, ends - table.length),
        ("meta/episodes: dataset_to_index", table.stop, ends),
        ("meta/tasks.parquet: task_index", np.sort([*tasks]), np.arange(len(tasks))),
        ("data: task_index", columns[layout.TASK_INDEX], columns[layout.TASK_INDEX].clip(0, len(tasks) - 1)),
        ("data: index", columns[layout.INDEX], np.arange(len(frame))),
        ("data: episode_index", columns[layout.EPISODE_INDEX], np.repeat(table.index, table.length)),
        ("data: frame_index", columns[layout.FRAME_INDEX], frame),
        (f"data: timestamp at {dataset.fps:.6g} frames per second", columns[layout.TIMESTAMP], frame / dataset.fps),
    ):
        if text := _differ(found, wanted, _LATE + 1e-6 * np.abs(wanted)):
            yield Finding(place, text)
    if unknown := {text for texts in table.tasks for text in texts} - {*tasks.values()}:
        text = f"names the task {list_first([*map(repr, unknown)])}, which {layout.TASKS} does not hold"
        yield Finding("meta/episodes: tasks", text)


def _differ(found: NDArray[Any], wanted: Any, tolerance: Any = 0) -> str:
    """Return where numbers (N,) first differ, and how many do; "" if none do."""
    if len(found) != len(wanted):
        return f"{len(found):,} values; expected {len(wanted):,}"
    bad = np.flatnonzero(~(np.abs(found.astype(np.float64) - wanted) <= tolerance))
    if not len(bad):
        return ""
    if len(found) == 1:
        return f"{found[0]:.6g}; expected {wanted[0]:.6g}"
    return f"{found[bad[0]]:.6g} at {bad[0]:,}; expected {wanted[bad[0]]:.6g} ({len(bad):,} of {len(found):,} differ)"


def check_numbers(dataset: Dataset) -> Iterator[Finding]:
    """Check that numbers are finite, and that `meta/stats.json` has their statistics."""
    root, ends = dataset.root, np.cumsum(dataset.episodes.length)
    stored = dataset.statistics if (root / layout.STATS).exists() else None
    if stored is None:
        yield warning(layout.STATS, "is missing: LeRobot cannot normalise without it")
    for feature in dataset.info.of_dtype(*NUMBERS, *PICTURES):
        key = feature.key
        text = ""
        table = (stored or {}).get(feature.key)
        if feature.dtype in NUMBERS:
            values = dataset.columns([key])[key].reshape(len(dataset), -1).astype(np.float64, copy=False)
            if len(bad := np.flatnonzero(~np.isfinite(values).all(axis=1))):
                episodes = np.unique(np.searchsorted(ends, bad, side="right")).tolist()
                what = f"not finite in row {bad[0]:,} ({len(bad):,} such rows)"
                lost = of_episodes(root, f"data: {key}", what, episodes)
                yield replace(lost, is_error=True, remedy="" if journals_of(root).is_dir() else lost.remedy)
            elif table is not None:
                text = _compare(table, values, feature)
        if stored is not None and key not in INDEX_FEATURES and (text or table is None):  # index statistics are unused
            yield Finding(f"{layout.STATS}: {key}", text or "is missing")


def _compare(stored: dict[str, NDArray[Any]], values: NDArray[Any], feature: Feature) -> str:
    """Return how stored statistics differ from those of `values` (N, n), or along a matrix's last axis; "" if equal."""
    flat = values if stored["mean"].size == values.shape[1] else values.reshape(-1, feature.shape[-1])
    largest, spread = np.abs(flat).max(axis=0), flat.std(axis=0)
    most = np.where(spread > _NOISE * largest, _OF_SPREAD * spread, np.inf)
    for name, share in _TOLERANCES.items():
        tolerance = np.minimum(share * largest, most) + 1e-9
        if text := _differ(stored[name].reshape(-1), getattr(np, name)(flat, axis=0), tolerance):
            return f"{name} is {text}"
    return "" if stored["count"][0] == len(values) else f"count is {stored['count'][0]}; expected {len(values)}"


def check_frames(dataset: Dataset) -> Iterator[Finding]:
    """Check that every row has a picture in its data file, or a video frame at its time, without decoding."""
    table, root = dataset.episodes, dataset.root
    for key in [feature.key for feature in dataset.info.of_dtype("image")]:
        for path in dataset.data_files:
            cells: Any = read_file(path, [key]).column(key).combine_chunks()
            if lacking := cells.field("bytes").null_count:
                place = f"{path.relative_to(root).as_posix()}: {key}"
                yield Finding(place, f"{lacking:,} of {len(cells):,} rows have no picture")
    for key, clips in table.clips.items():
        size = dataset.features[key].picture_size
        for name in dict.fromkeys(clips.files):
            with reading(root / name), closing(open_video(root / name, size)) as container:
                [stream] = container.streams.video
                tick = float(stream.time_base or 1)
                times = np.sort([one.pts * tick for one in container.demux(stream) if one.pts is not None])
            rows = [row for row, file in enumerate(clips.files) if file == name]
            wanted = np.concatenate([clips.starts[row] + np.arange(table.length[row]) / dataset.fps for row in rows])
            lacking = int((np.searchsorted(times, wanted - _LATE) == np.searchsorted(times, wanted + _LATE)).sum())
            if lacking or len(times) != len(wanted):
                text = f"{len(times):,} frames for {len(wanted):,} rows; {lacking:,} rows have no frame at their time"
                yield Finding(name, text)


def check_own(dataset: Dataset) -> Iterator[Finding]:
    """Check our own columns and `meta/manip_il.json`: names and shapes."""
    own, features = dataset.own, dataset.features
    if own is None:
        if {s.SIM_STATE, s.EXECUTED_ACTION} <= features.keys():
            text = "is missing (LeRobot's tools drop it): robot, task and versions are unknown"
            yield warning(layout.OURS, text, "copy it from the dataset that this one was made from")
        return
    there: dict[str, Any] = {key: ([*one.shape], one.names) for key, one in features.items()} | {"fps": dataset.fps}
    ours = {key: ([*one["shape"]], one["names"]) for key, one in s.features(own.spec).items()}
    for key, wanted in {**ours, "fps": own.spec.fps}.items():
        if (found := there.get(key, "missing")) != wanted:
            yield Finding(layout.OURS, f"{key} is {str(wanted)[:80]}, but {layout.INFO} has {str(found)[:80]}")


CHECKS = (check_leftovers, check_info, check_rows, check_numbers, check_frames, check_own)
