"""Files and rows: what `info.json`, the episodes, the tasks and the statistics say, against what is there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import journal
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.fingerprint import compare_fingerprints, environment_fingerprint
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES, Feature
from manip_il.doctor.finding import ERROR, WARNING, Finding, delete, journals_of, list_first, repair_it, restore
from manip_il.errors import ManipError

_AXES = (["height", "width", "channels"], ["height", "width", "channel"], ["channels", "height", "width"])
_TOLERANCES = {"min": 1e-5, "max": 1e-5, "mean": 1e-4, "std": 2e-3}  # shares: LeRobot computes in float32
_TEMPORARY = re.compile(r"\..*\.tmp|.*\.(partial|incomplete|ffconcat)|tmp[a-z0-9_]{8}|images|\.cache")


def check_leftovers(dataset: Dataset) -> Iterator[Finding]:
    """Check that no recorder, writer or download died here."""
    root = dataset.root
    for path in sorted([*root.glob(layout.DATA_FILES), *root.glob(layout.EPISODES_FILES)]):
        if path.read_bytes()[-4:] != b"PAR1":
            text = "has no footer: its recorder died before it closed the file (LeRobot's does in finalize())"
            yield Finding(ERROR, path.relative_to(root).as_posix(), text, restore(root))
    for path in leftovers(root):
        text = "left by a recorder, writer or download that died"
        yield Finding(WARNING, path.relative_to(root.absolute().parent).as_posix(), text, repair_it(root))
    for path in journal.list_episodes(journals_of(root)):
        try:
            journal.read_journal(path)
        except ManipError as problem:
            yield Finding(WARNING, path.name, str(problem), "the dataset itself does not need it")


def leftovers(root: Path) -> list[Path]:
    """Return temporary files and folders in a dataset and beside it, which nobody needs."""
    root = root.absolute()
    inside = [path for path in [*root.iterdir(), *root.glob("meta/*")] if _TEMPORARY.fullmatch(path.name)]
    beside = root.parent.glob(f".{root.name}.*.partial")
    return sorted(path for path in [*inside, *beside] if path.is_file() or any(path.rglob("*.*")))


def check_info(dataset: Dataset) -> Iterator[Finding]:
    """Check that `meta/info.json` has names and shapes with which LeRobot trains, every column, and right counts."""
    info, root = dataset.info, dataset.root
    for key, feature in info.features.items():
        shape, names = list(feature.shape), feature.names
        if feature.dtype in PICTURES and not _has_axes(feature):
            text = f"a camera of shape {shape} with names {names}, on which LeRobot does not train"
            remedy = 'set them to [height, width, 3] and ["height", "width", "channels"] there'
            yield Finding(ERROR, f"{layout.INFO}: {key}", text, remedy)
        elif isinstance(names, list) and len(names) not in (feature.size, len(shape)):
            text = f"{len(names)} names for shape {shape}"
            yield Finding(ERROR, f"{layout.INFO}: {key}", text, "name each number there, or set names to null")
    for what, count in {
        "episodes": len(dataset.episodes),
        "frames": int(dataset.episodes.length.sum()),
        "tasks": len(dataset.tasks),
    }.items():
        if (said := getattr(info, what)) not in (None, count):
            text = f"total_{what} is {said:,}; its table in meta has {count:,}"
            yield Finding(ERROR, layout.INFO, text, repair_it(root))
    wanted = {key for key, feature in info.features.items() if feature.dtype != "video"} | {*INDEX_FEATURES}
    for path in dataset.data_files:
        if odd := sorted(wanted ^ {*pq.read_schema(path).names}):
            text = f"has not the columns of {layout.INFO}, as LeRobot needs it: {list_first(odd)}"
            yield Finding(ERROR, path.relative_to(root).as_posix(), text, restore(root))


def _has_axes(feature: Feature) -> bool:
    """Whether LeRobot's trainer finds the channels of a camera, which it does by name."""
    if len(feature.shape) != 3 or feature.names not in _AXES:
        return False
    return feature.shape[0 if feature.names[0] == "channels" else 2] in (1, 3)


def check_rows(dataset: Dataset) -> Iterator[Finding]:
    """Check that episodes count from 0 and follow each other, that the rows are theirs, at the rate's times."""
    table, tasks = dataset.episodes, dataset.tasks
    ends = np.cumsum(table.length)
    frame = np.concatenate([np.arange(length) for length in table.length])
    index, episode, moment, time, task = (
        dataset.columns([key])[key].reshape(-1)
        for key in (layout.INDEX, layout.EPISODE_INDEX, layout.FRAME_INDEX, layout.TIMESTAMP, layout.TASK_INDEX)
    )
    texts = [text for texts in table.tasks for text in texts]
    for place, found, wanted in (
        ("meta/episodes: episode_index", table.index, np.arange(len(table))),
        ("meta/episodes: dataset_from_index", table.start, ends - table.length),
        ("meta/episodes: dataset_to_index", table.stop, ends),
        ("meta/episodes: known tasks", np.isin(texts, [*tasks.values()]), np.ones(len(texts))),
        ("meta/tasks.parquet: task_index", np.sort([*tasks]), np.arange(len(tasks))),
        ("data: task_index", task, np.clip(task, 0, len(tasks) - 1)),
        ("data: index", index, np.arange(len(frame))),
        ("data: episode_index", episode, np.repeat(table.index, table.length)),
        ("data: frame_index", moment, frame),
        (f"data: timestamp at {dataset.fps:.6g} frames a second", time, frame / dataset.fps),
    ):
        if text := _differ(found, wanted, 1e-4 + 1e-6 * np.abs(wanted)):
            yield Finding(ERROR, place, text, restore(dataset.root))


def _differ(found: NDArray[Any], wanted: NDArray[Any], tolerance: Any = 0) -> str:
    """Return where numbers (N,) differ first, and how many do; empty if none does."""
    if len(found) != len(wanted):
        return f"{len(found):,} values; expected {len(wanted):,}"
    bad = np.flatnonzero(~(np.abs(found.astype(np.float64) - wanted) <= tolerance))
    if not len(bad):
        return ""
    return (
        f"{found[bad[0]]:.6g} in row {bad[0]:,}; expected {wanted[bad[0]]:.6g} ({len(bad):,} of {len(found):,} wrong)"
    )


def check_numbers(dataset: Dataset) -> Iterator[Finding]:
    """Check that numbers are finite, and that their statistics are those of `meta/stats.json`."""
    root, ends = dataset.root, np.cumsum(dataset.episodes.length)
    stored = dataset.statistics if (root / layout.STATS).exists() else None
    if stored is None:
        yield Finding(WARNING, layout.STATS, "is missing: LeRobot normalises nothing without it", repair_it(root))
    for key, feature in dataset.features.items():
        text = "is missing" if stored is not None and key not in stored else ""
        if feature.dtype in NUMBERS:
            values = dataset.columns([key])[key].reshape(len(dataset), -1).astype(np.float64)
            if len(bad := np.flatnonzero(~np.isfinite(values).all(axis=1))):
                remedy = delete(root, sorted({*np.searchsorted(ends, bad, side="right").tolist()}))
                remedy = repair_it(root) if journals_of(root).is_dir() else remedy
                yield Finding(ERROR, f"data: {key}", f"no number in row {bad[0]:,} ({len(bad):,} such rows)", remedy)
                continue
            text = text or (_stale(stored[key], values, feature) if stored is not None else "")
        if text and feature.dtype in (*NUMBERS, *PICTURES):
            severity = WARNING if key in INDEX_FEATURES else ERROR  # LeRobot's tools leave those as they were
            yield Finding(severity, f"{layout.STATS}: {key}", text, repair_it(root))


def _stale(stored: dict[str, NDArray[Any]], values: NDArray[Any], feature: Feature) -> str:
    """Return how statistics differ from a column's, (N, n); a matrix has them over its last axis."""
    flat = values if stored["mean"].size == values.shape[1] else values.reshape(-1, feature.shape[-1])
    tolerance = np.abs(flat).max(axis=0)
    for name, share in _TOLERANCES.items():
        if text := _differ(stored[name].reshape(-1), getattr(np, name)(flat, axis=0), share * tolerance + 1e-9):
            return f"{name} is {text}".replace("in row", "at place")
    return "" if stored["count"][0] == len(values) else f"count is {stored['count'][0]}; there are {len(values):,} rows"


def check_own(dataset: Dataset) -> Iterator[Finding]:
    """Check this program's own columns and file: names, rate, labels, drivers, seeds, versions."""
    own, features, root = dataset.own, dataset.features, dataset.root
    if own is None:
        if {s.SIM_STATE, s.EXECUTED_ACTION} <= features.keys():
            text = "is missing (LeRobot's tools drop it): robot, task and versions are unknown"
            yield Finding(WARNING, layout.OURS, text, "copy it from the dataset that this one was made from")
        return
    said = {key: (tuple(one["shape"]), one["names"]) for key, one in layout.all_features(own.spec).items()}
    said |= {"fps": own.spec.fps, "robot_type": own.spec.lerobot_type}
    there = {key: (one.shape, one.names) for key, one in features.items()}
    there |= {"fps": dataset.fps, "robot_type": dataset.info.robot}
    for key in [key for key, value in said.items() if there.get(key) != value][:1]:
        text = f"{key} is {str(there.get(key, 'missing'))[:80]}; {layout.OURS} says {str(said[key])[:80]}"
        yield Finding(ERROR, layout.INFO, text, restore(root))
        return
    starts = np.repeat(dataset.episodes.start, dataset.episodes.length)
    valid, actor, seed = (dataset.columns([key])[key].reshape(-1) for key in (s.LABEL_VALID, s.ACTOR, s.SEED))
    for key, found, wanted in (
        (s.LABEL_VALID, valid, valid.clip(0, 1)),
        (s.ACTOR, actor, actor.clip(0, 2)),
        (s.SEED, seed, seed[starts]),
    ):
        if text := _differ(found, wanted):
            yield Finding(ERROR, f"data: {key}", text, restore(root))
    here = environment_fingerprint(b"", {})
    theirs = {key: one for key, one in own.fingerprint.items() if not key.endswith("_sha256") and key != "processor"}
    for text in compare_fingerprints(
        "the dataset", theirs, "this installation", {key: here.get(key) for key in theirs}
    ):
        yield Finding(WARNING, layout.OURS, text, "use these versions if results must be equal")


CHECKS = (check_leftovers, check_info, check_rows, check_numbers, check_own)
