"""Examine a dataset by every check, and repair what its journals or its own data allow."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import exclusive, write_file
from manip_il.data.build import build
from manip_il.data.gate import check_arrived
from manip_il.data.info import Feature
from manip_il.data.parquet_files import to_numpy
from manip_il.data.statistics import RunningStats
from manip_il.doctor.cameras import check_pictures, check_videos
from manip_il.doctor.finding import Finding, Remedy, Severity, count_frames, error, list_first, plural
from manip_il.doctor.leftovers import (
    BESIDE,
    check_journals,
    check_leftovers,
    check_recorder,
    check_stale_files,
    count_readable,
)
from manip_il.doctor.meta import (
    check_episodes,
    check_fingerprint,
    check_footers,
    check_info,
    check_regular,
    check_spec,
    check_tasks,
)
from manip_il.doctor.patient import Patient
from manip_il.doctor.rows import check_columns, check_finite, check_rows, check_statistics, check_task_numbers
from manip_il.errors import ManipError

Check = Callable[[Patient], Iterator[Finding]]

CHECKS: tuple[Check, ...] = (
    check_info,
    check_regular,
    check_recorder,
    check_footers,
    check_episodes,
    check_tasks,
    check_columns,
    check_rows,
    check_task_numbers,
    check_finite,
    check_statistics,
    check_videos,
    check_pictures,
    check_spec,
    check_fingerprint,
    check_stale_files,
    check_leftovers,
    check_journals,
)


def examine(dataset: Patient, checks: Sequence[Check] = CHECKS) -> Iterator[Finding]:
    """Yield every finding, as it is found; none for a dataset that is whole.

    Every file is opened in a child process first; if that needs too much memory or time, this is the only finding.
    Raises nothing, whatever the folder holds.
    """
    try:
        check_arrived(dataset.root, strict=False)
    except ManipError as problem:
        yield error(str(dataset.root), str(problem), Remedy.NONE)
        return
    for check in checks:
        try:
            yield from check(dataset)
        except Exception as problem:  # one check that fails must not hide the others
            what = check.__name__.replace("_", " ")
            text = f"{what} could not be finished: {type(problem).__name__}: {problem}"
            yield error(str(dataset.root), text, Remedy.NONE)


def examine_folder(root: Path) -> list[Finding]:
    """Return all findings about a folder."""
    return list(examine(Patient(root)))


def has_errors(findings: Sequence[Finding]) -> bool:
    """Return whether one of the findings is an error."""
    return any(finding.severity is Severity.ERROR for finding in findings)


def verdict(dataset: Patient, findings: Sequence[Finding]) -> str:
    """Return one line: how many episodes and frames are whole, or how many errors and warnings there are."""
    severities = [finding.severity for finding in findings]
    counts = {kind.value: severities.count(kind) for kind in Severity}
    text = ", ".join(plural(count, name) for name, count in counts.items() if count)
    if has_errors(findings) or dataset.info is None:
        return f"{dataset.root}: {text}"
    whole = count_frames(dataset.info.episodes, dataset.info.frames)
    return f"{dataset.root}: {whole}: whole{f', {text}' if text else ''}"


def repair(dataset: Patient, findings: Sequence[Finding]) -> Iterator[str]:
    """Repair what can be repaired; yield one line for each thing that was done, or was not and why.

    Raises `FolderBusyError` where another process is at work on the dataset. Examine the folder anew afterwards.
    """
    with exclusive(dataset.root):
        to_rebuild = [one for one in findings if one.remedy is Remedy.REBUILD]
        reason = _why_no_rebuild(dataset) if to_rebuild else ""
        if to_rebuild and not reason:
            yield from _rebuild(dataset, findings)
            return
        kept = _free_name(dataset.root)
        yield from _in_place(dataset, findings, kept)
        if kept.exists():
            yield f"what was replaced or moved is kept in {kept}"
        if to_rebuild:
            yield f"not repaired, as {reason}: {list_first(one.place for one in to_rebuild)}"
        for one in findings:
            if one.remedy is Remedy.NONE and one.severity is Severity.ERROR:
                yield f"not repaired, as there is no copy of it: {one.place}"


def _why_no_rebuild(dataset: Patient) -> str:
    """Return why the dataset cannot be built from its journals; empty where it can."""
    folder = dataset.journals
    if not folder.is_dir():
        return f"there are no journals in {folder.name} to build it from"
    try:
        count = count_readable(folder)
    except ManipError as problem:
        return str(problem)
    held = len(np.unique(dataset.scan.runs.episode))
    if count == 0:
        return f"{folder.name} holds no readable journal"
    if count < held:
        return f"{folder.name} makes {plural(count, 'episode')} and the dataset's files still hold {held}"
    return ""


def _rebuild(dataset: Patient, findings: Sequence[Finding]) -> Iterator[str]:
    root = dataset.root
    kept = _free_name(root)
    root.rename(kept)
    for one in findings:
        if one.remedy is Remedy.MOVE and one.place.startswith(BESIDE):  # which the builder would delete
            _move(*_paths(dataset, one.place, kept))
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


def _in_place(dataset: Patient, findings: Sequence[Finding], kept: Path) -> Iterator[str]:
    """Move leftovers away and compute statistics."""
    if any(one.remedy is Remedy.STATISTICS for one in findings) and dataset.reads_all_rows:
        yield _compute_statistics(dataset, kept)
    for place in dict.fromkeys(one.place for one in findings if one.remedy is Remedy.MOVE):
        source, target = _paths(dataset, place, kept)
        if not _is_inside(dataset.root, source, beside=place.startswith(BESIDE)):
            yield f"not moved, as it is outside the dataset (reached through a link): {place}"
            continue
        _move(source, target)
        yield f"moved away: {place}"


def _compute_statistics(dataset: Patient, kept: Path) -> str:
    """Compute statistics of all columns of numbers; those of pictures stay as they are."""
    path = dataset.root / layout.STATS
    if not _is_inside(dataset.root, path):
        return f"not recomputed: {layout.STATS} is outside the dataset (reached through a link)"
    if path.exists():
        (kept / layout.STATS).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, kept / layout.STATS)
    stats: dict[str, Any] = dict(dataset.stats or {})
    features = dataset.info.features if dataset.info else {}
    sound = [key for key, moments in dataset.scan.moments.items() if moments.rows and not moments.bad_rows]
    for key in sound:
        stats[key] = _statistics(dataset, features[key])
    write_file(path, json.dumps(stats, indent=4, ensure_ascii=False).encode())
    return f"recomputed from the data: {layout.STATS}, {plural(len(sound), 'column')}"


def _statistics(dataset: Patient, feature: Feature) -> dict[str, list[float]]:
    """Compute one column's statistics; a matrix' over its last axis, as LeRobot has them."""
    last = feature.shape[-1] if feature.shape else 1
    with closing(RunningStats(dataset.root)) as running:
        for shard in dataset.data_shards:
            for table in shard.tables([feature.key]):
                values = to_numpy(table.column(feature.key), feature.dtype, feature.shape, exact=True)
                running.add({feature.key: values.reshape(-1, last)})
        return {**running.result()[feature.key], "count": [dataset.scan.moments[feature.key].rows]}


def _paths(dataset: Patient, place: str, kept: Path) -> tuple[Path, Path]:
    """Return the path of a leftover, and the one that it is moved to."""
    if place.startswith(BESIDE):
        return dataset.root.with_name(Path(place).name), kept / Path(place).name
    return dataset.root / place, kept / place


def _is_inside(root: Path, path: Path, *, beside: bool = False) -> bool:
    """Return whether a file or folder is in the dataset itself, or beside it, and not reached through a link."""
    folder, home = path.parent.resolve(), root.resolve()
    return folder == home.parent if beside else folder.is_relative_to(home)


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(source, target)


def _free_name(root: Path) -> Path:
    """Return the first of `<root>.before-repair`, `<root>.before-repair-2`, ... that is not there."""
    name = f"{root.name}.before-repair"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(path for path in map(root.with_name, names) if not path.exists())
