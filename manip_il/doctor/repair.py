"""Put right what follows from the journals, or from the data itself; whatever is replaced is kept beside it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import exclusive, write_file
from manip_il.data.build import build
from manip_il.data.info import Feature
from manip_il.data.lerobot_stats import RunningStats
from manip_il.data.shards import to_array
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, Remedy, Severity, plural, some
from manip_il.doctor.journals import readable_episodes
from manip_il.doctor.leftovers import BESIDE
from manip_il.errors import ManipError


def repair(dataset: Dataset, findings: Sequence[Finding]) -> Iterator[str]:
    """Do what can be done about the findings; yields what was done, or not and why, one line each.

    Raises `FolderBusyError` where another process is at work on the dataset. Examine the folder anew afterwards.
    """
    with exclusive(dataset.root):
        wants_rebuild = [one for one in findings if one.remedy is Remedy.REBUILD]
        reason = _why_not_rebuild(dataset) if wants_rebuild else ""
        if wants_rebuild and not reason:
            yield from _rebuild(dataset, findings)
            return
        kept = free_name(dataset.root)
        yield from _in_place(dataset, findings, kept)
        if kept.exists():
            yield f"what was replaced or moved is kept in {kept}"
        if wants_rebuild:
            yield f"not repaired, as {reason}: {some(one.place for one in wants_rebuild)}"
        for one in findings:
            if one.remedy is Remedy.NONE and one.severity is Severity.ERROR:
                yield f"not repaired, as there is no copy of it: {one.place}"


def _why_not_rebuild(dataset: Dataset) -> str:
    """Why the journals are of no help; empty where the dataset can be built from them."""
    folder = dataset.journals
    if not folder.is_dir():
        return f"there are no journals in {folder.name} to build it from"
    try:
        count = readable_episodes(folder)
    except ManipError as problem:
        return str(problem)
    held = len(np.unique(dataset.scan.runs.episode))
    if count == 0:
        return f"{folder.name} holds no readable journal"
    if count < held:
        return f"{folder.name} makes {plural(count, 'episode')} and the dataset's files still hold {held}"
    return ""


def _rebuild(dataset: Dataset, findings: Sequence[Finding]) -> Iterator[str]:
    root = dataset.root
    kept = free_name(root)
    root.rename(kept)
    for one in findings:
        if one.remedy is Remedy.MOVE and one.place.startswith(BESIDE):  # which the builder would delete
            _move(*_way(dataset, one.place, kept))
    try:
        result = build(dataset.journals, root)
    except BaseException:
        if not root.exists():
            kept.rename(root)
        raise
    for line in result.damaged:
        yield f"left out: {line}"
    count = plural(result.info.episodes, "episode")
    yield f"built again from {dataset.journals.name}: {count}; what was there is kept in {kept}"


def _in_place(dataset: Dataset, findings: Sequence[Finding], kept: Path) -> Iterator[str]:
    """Move leftovers away and compute statistics."""
    if any(one.remedy is Remedy.STATISTICS for one in findings) and dataset.reads_all_rows:
        yield _compute_statistics(dataset, kept)
    for place in dict.fromkeys(one.place for one in findings if one.remedy is Remedy.MOVE):
        source, target = _way(dataset, place, kept)
        if not _is_inside(dataset.root, source, beside=place.startswith(BESIDE)):
            yield f"not moved, as it is outside the dataset (reached through a link): {place}"
            continue
        _move(source, target)
        yield f"moved away: {place}"


def _compute_statistics(dataset: Dataset, kept: Path) -> str:
    """Statistics of every column of numbers; those of pictures stay as they are."""
    path = dataset.root / layout.STATS
    if not _is_inside(dataset.root, path):
        return f"not recomputed: {layout.STATS} is outside the dataset (reached through a link)"
    if path.exists():
        (kept / layout.STATS).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, kept / layout.STATS)
    stats: dict[str, Any] = dict(dataset.stats or {})
    features = dataset.info.features if dataset.info else {}
    fine = [key for key, moments in dataset.scan.moments.items() if moments.rows and not moments.bad_rows]
    for key in fine:
        stats[key] = _statistics(dataset, features[key])
    write_file(path, json.dumps(stats, indent=4, ensure_ascii=False).encode())
    return f"recomputed from the data: {layout.STATS}, {plural(len(fine), 'column')}"


def _statistics(dataset: Dataset, feature: Feature) -> dict[str, list[float]]:
    """Of one column; of a matrix over its last axis, as LeRobot has them."""
    last = feature.shape[-1] if feature.shape else 1
    with closing(RunningStats(dataset.root)) as running:
        for shard in dataset.data_shards:
            for table in shard.tables([feature.key]):
                values = to_array(table.column(feature.key), feature.dtype, feature.shape)
                running.add({feature.key: values.reshape(-1, last)})
        return {**running.result()[feature.key], "count": [dataset.scan.moments[feature.key].rows]}


def _way(dataset: Dataset, place: str, kept: Path) -> tuple[Path, Path]:
    """From where to where a leftover is moved."""
    if place.startswith(BESIDE):
        return dataset.root.with_name(Path(place).name), kept / Path(place).name
    return dataset.root / place, kept / place


def _is_inside(root: Path, path: Path, *, beside: bool = False) -> bool:
    """Whether a file or folder stands in the dataset itself, or beside it; links to other folders do not count."""
    folder, home = path.parent.resolve(), root.resolve()
    return folder == home.parent if beside else folder.is_relative_to(home)


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(source, target)


def free_name(root: Path) -> Path:
    """Return the first of `<root>.before-repair`, `<root>.before-repair-2`, ... that is not there."""
    first = root.with_name(f"{root.name}.before-repair")
    number, path = 1, first
    while path.exists():
        number += 1
        path = first.with_name(f"{first.name}-{number}")
    return path
