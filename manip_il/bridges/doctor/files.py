"""What a finding is, and checks that files agree: `info.json`, episodes, tasks, statistics,
rows, videos.
"""

from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.camera import open_video
from manip_il.data.dataset import Dataset
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES, Feature, reading
from manip_il.data.parquet_files import column_names, read_file

_AXES = (
    ["height", "width", "channels"],
    ["height", "width", "channel"],
    ["channels", "height", "width"],
)
_TOLERANCES = {"min": 1e-5, "max": 1e-5, "mean": 1e-4, "std": 2e-3}  # shares of the largest value
# tolerance as a share of the standard deviation, which LeRobot computes in float32
_OF_SPREAD = 0.05
# a spread of less than this share of the largest value is lost in float32, so it is not compared
_NOISE = 1e-5
# largest difference in time between a video frame and its row that LeRobot's reader accepts [s]
_LATE = 1e-4


@dataclass(frozen=True)
class Finding:
    """One line of a report.

    Errors are wrong data, or data on which LeRobot cannot train; others are warnings.

    Args:
        place: A file in the dataset or next to it, a column, or the dataset.
        text: What is wrong.
        remedy: What to do; "" for what `data repair` may mend.
        is_error: Whether it is an error.
    """

    place: str
    text: str
    remedy: str = ""
    is_error: bool = True

    def __str__(self) -> str:
        line = f"{self.place}: {self.text}" + (self.remedy and f"; {self.remedy}")
        return f"{'error' if self.is_error else 'warning':7}  {' '.join(line.split())}"


warning = partial(Finding, is_error=False)


def of_episodes(
    root: Path, place: str, text: str, episodes: Collection[int], *, is_error: bool = False
) -> Finding:
    """Return a finding about episodes that cannot be repaired.

    Args:
        root: The dataset.
        place: A column or camera.
        text: What is wrong.
        episodes: Their numbers, which `lerobot-edit-dataset` deletes.
        is_error: Whether it is an error.
    """
    remedy = (
        "record these again, or delete them: "
        f"lerobot-edit-dataset --repo_id=local/{root.absolute().name} --root={root} "
        f"--operation.type=delete_episodes --new_root={root}_kept "
        f'--operation.episode_indices="[{", ".join(map(str, episodes))}]"'
    )
    return Finding(place, f"{text} (episodes {list_first(episodes)})", remedy, is_error)


def list_first(values: Collection[object]) -> str:
    """List the first three values and count the rest: `3, 7, 9 and 2 more`."""
    texts = [str(value) for value in values]
    return ", ".join(texts[:3]) + (f" and {len(texts) - 3:,} more" if len(texts) > 3 else "")


def check_info(dataset: Dataset) -> Iterator[Finding]:
    """Check that `meta/info.json` has every column, and cameras that LeRobot can train on."""
    for feature in dataset.info.of_dtype(*PICTURES):
        shape, names = feature.shape, feature.names
        channels = 0 if names == _AXES[-1] else 2
        if names not in _AXES or len(shape) != 3 or shape[channels] not in (1, 3):
            text = f"a camera of shape {[*shape]} with names {names}, on which LeRobot cannot train"
            remedy = 'set [height, width, 3] and ["height", "width", "channels"] there'
            is_error = [*(names or ())][:2] != _AXES[0][:2]  # some of its policies train
            yield Finding(f"{layout.INFO}: {feature.key}", text, remedy, is_error)
    columns = [key for key, feature in dataset.features.items() if feature.dtype != "video"]
    for path in dataset.data_files:
        if odd := {*columns, *INDEX_FEATURES} ^ {*column_names(path)}:
            text = f"differs from {layout.INFO} in columns, so LeRobot cannot load it"
            place = path.relative_to(dataset.root).as_posix()
            yield Finding(place, f"{text}: {list_first(sorted(odd))}")


def check_rows(dataset: Dataset) -> Iterator[Finding]:
    """Check that episodes follow each other from 0, and that rows have their indices and times."""
    table = dataset.episodes
    tasks = dataset.tasks
    info = dataset.info
    ends = np.cumsum(table.length)
    frame = np.concatenate([np.arange(length) for length in table.length])
    columns = {key: dataset.columns([key])[key].reshape(-1) for key in INDEX_FEATURES}
    task = columns[layout.TASK_INDEX]
    timestamp = f"data: timestamp at {dataset.fps:.6g} frames per second"
    for place, found, wanted in (
        (f"{layout.INFO}: total_episodes", [info.episodes], [len(table)]),
        (
            f"{layout.INFO}: total_tasks",
            [len(tasks) if info.tasks is None else info.tasks],
            [len(tasks)],
        ),
        ("meta/episodes: episode_index", table.index, np.arange(len(table))),
        ("meta/episodes: dataset_from_index", table.start, ends - table.length),
        ("meta/episodes: dataset_to_index", table.stop, ends),
        ("meta/tasks.parquet: task_index", sorted(tasks), np.arange(len(tasks))),
        ("data: task_index", task, task.clip(0, len(tasks) - 1)),
        ("data: index", columns[layout.INDEX], np.arange(len(frame))),
        (
            "data: episode_index",
            columns[layout.EPISODE_INDEX],
            np.repeat(table.index, table.length),
        ),
        ("data: frame_index", columns[layout.FRAME_INDEX], frame),
        (timestamp, columns[layout.TIMESTAMP], frame / dataset.fps),
    ):
        if text := _differ(found, wanted, _LATE + 1e-6 * np.abs(wanted)):
            yield Finding(place, text)
    if unknown := {text for texts in table.tasks for text in texts} - {*tasks.values()}:
        names = list_first([*map(repr, unknown)])
        yield Finding(
            "meta/episodes: tasks", f"names the task {names}, which {layout.TASKS} does not hold"
        )


def _differ(found: Any, wanted: Any, tolerance: Any) -> str:
    """Return where numbers (N,) first differ, and how many do; "" if none do."""
    if len(found) != len(wanted):
        return f"{len(found):,} values; expected {len(wanted):,}"
    bad = np.flatnonzero(~(np.abs(np.asarray(found, np.float64) - wanted) <= tolerance))
    if not len(bad):
        return ""
    row = bad[0]
    if len(found) == 1:
        return f"{found[0]:.6g}; expected {wanted[0]:.6g}"
    count = f"({len(bad):,} of {len(found):,} differ)"
    return f"{found[row]:.6g} at {row:,}; expected {wanted[row]:.6g} {count}"


def check_numbers(dataset: Dataset) -> Iterator[Finding]:
    """Check that numbers are finite, and that `meta/stats.json` has their statistics."""
    ends = np.cumsum(dataset.episodes.length)
    has_statistics = (dataset.root / layout.STATS).exists()
    if not has_statistics:
        yield warning(layout.STATS, "is missing: LeRobot cannot normalise without it")
    for feature in dataset.info.of_dtype(*NUMBERS, *PICTURES):
        key = feature.key
        table = dataset.statistics.get(key) if has_statistics else None
        text = "" if table else "is missing"
        if feature.dtype in NUMBERS:
            values = (
                dataset.columns([key])[key].reshape(len(dataset), -1).astype(np.float64, copy=False)
            )
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(bad):
                what = f"not finite in row {bad[0]:,} ({len(bad):,} such rows)"
                episodes = np.unique(np.searchsorted(ends, bad, side="right")).tolist()
                yield of_episodes(dataset.root, f"data: {key}", what, episodes, is_error=True)
            elif table:
                text = _compare(table, values, feature)
        if has_statistics and text and key not in INDEX_FEATURES:  # whose statistics are unused
            yield Finding(f"{layout.STATS}: {key}", text)


def _compare(stored: dict[str, NDArray[Any]], values: NDArray[Any], feature: Feature) -> str:
    """Return how stored statistics differ from those of `values` (N, n), or along a matrix's
    last axis; "" if equal.
    """
    flat = (
        values if stored["mean"].size == values.shape[1] else values.reshape(-1, feature.shape[-1])
    )
    largest = np.abs(flat).max(axis=0)
    spread = flat.std(axis=0)
    most = np.where(spread > _NOISE * largest, _OF_SPREAD * spread, np.inf)
    for name, share in _TOLERANCES.items():
        tolerance = np.minimum(share * largest, most) + 1e-9
        if text := _differ(stored[name].reshape(-1), getattr(np, name)(flat, axis=0), tolerance):
            return f"{name} is {text}"
    count = _differ(stored["count"], [len(values)], 0)
    return count and f"count is {count}"


def check_frames(dataset: Dataset) -> Iterator[Finding]:
    """Check that every row has a picture in its data file, or a video frame at its time, without
    decoding.
    """
    table, root = dataset.episodes, dataset.root
    for feature in dataset.info.of_dtype("image"):
        for path in dataset.data_files:
            cells: Any = read_file(path, [feature.key]).column(0).combine_chunks()
            if lacking := cells.field("bytes").null_count:
                place = f"{path.relative_to(root).as_posix()}: {feature.key}"
                yield Finding(place, f"{lacking:,} of {len(cells):,} rows have no picture")
    for key, clips in table.clips.items():
        size = dataset.features[key].picture_size
        for name in dict.fromkeys(file for file, _ in clips):
            with reading(root / name), closing(open_video(root / name, size)) as container:
                [stream] = container.streams.video
                tick = float(stream.time_base or 1)
                packets = container.demux(stream)
                times = np.sort([packet.pts * tick for packet in packets if packet.pts is not None])
            wanted = np.concatenate(
                [
                    start + np.arange(length) / dataset.fps
                    for (file, start), length in zip(clips, table.length, strict=True)
                    if file == name
                ]
            )
            first, after = (np.searchsorted(times, wanted + late) for late in (-_LATE, _LATE))
            lacking = int((first == after).sum())
            if lacking:
                frames = f"{len(times):,} frames for {len(wanted):,} rows"
                yield Finding(name, f"{frames}; {lacking:,} rows have no frame at their time")


def check_own(dataset: Dataset) -> Iterator[Finding]:
    """Check that a dataset with our columns has `meta/manip_il.json`."""
    if dataset.own is None and {s.SIM_STATE, s.EXECUTED_ACTION} <= dataset.features.keys():
        text = "is missing (LeRobot's tools drop it): robot, task and versions are unknown"
        yield warning(layout.OURS, text, "copy it from the dataset that this one was made from")


CHECKS = (check_info, check_rows, check_numbers, check_frames, check_own)
