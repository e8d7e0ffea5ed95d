"""Repair a dataset: from its journals, else leftovers, counts and statistics from what its own data say."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import exclusive
from manip_il.data.build import build
from manip_il.data.dataset import Dataset
from manip_il.data.info import NUMBERS
from manip_il.data.statistics import column_statistics
from manip_il.doctor.examine import has_errors
from manip_il.doctor.files import leftovers
from manip_il.doctor.finding import Finding, journals_of
from manip_il.doctor.pictures import picture_statistics
from manip_il.errors import ManipError


def repair(root: Path, findings: Sequence[Finding]) -> Iterator[str]:
    """Repair what can be repaired; yield one line for each thing that was done, or was not and why.

    Nothing is deleted: what is replaced or moved is kept in `ROOT.before-repair`. Raises `ManipError` for what cannot
    be read or is reached through links, and while another process is at work on it. Examine it anew afterwards.
    """
    if linked := [path for path in root.rglob("*") if not path.resolve().is_relative_to(root.resolve())]:
        raise ManipError(f"{linked[0]} is a link to elsewhere, where nothing is changed; repair a copy of the dataset")
    kept, number = root.with_name(f"{root.name}.before-repair"), 1
    while kept.exists():
        kept, number = root.with_name(f"{root.name}.before-repair-{number + 1}"), number + 1
    with exclusive(root):
        if has_errors(findings) and journals_of(root).is_dir():
            yield _rebuild(root, kept)
        for path in leftovers(root):
            kept.mkdir(exist_ok=True)
            shutil.move(path, kept)
            yield f"moved away: {path.name}"
        dataset = Dataset.open(root)
        if (counts := _counts(dataset)) and not (kept / "meta").exists():
            yield _write(root / layout.INFO, kept, counts)
        if any(finding.place.startswith(layout.STATS) for finding in findings):
            yield _write(root / layout.STATS, kept, _statistics(Dataset.open(root)))
        if kept.exists():
            yield f"what was replaced or moved is kept in {kept}"


def _rebuild(root: Path, kept: Path) -> str:
    """Build the dataset from its journals, unless they hold less than it does."""
    journals, fresh = journals_of(root), root.with_name(f"{root.name}.rebuilt")
    try:
        held = len(np.unique(Dataset.open(root).columns([layout.EPISODE_INDEX])[layout.EPISODE_INDEX]))
    except ManipError:
        held = 0  # nothing of it can be read
    try:
        result = build(journals, fresh, replace=True)
    except ManipError as problem:
        return f"not rebuilt: {problem}"
    if result.info.episodes < held:
        shutil.rmtree(fresh)
        return f"not rebuilt: {journals.name} makes {result.info.episodes} episodes, and {held} are still readable"
    root.rename(kept)
    fresh.rename(root)
    return "; left out: ".join([f"rebuilt from {journals.name}: {result.info.episodes} episodes", *result.damaged])


def _counts(dataset: Dataset) -> dict[str, Any]:
    """Return info.json with the counts of the tables; empty if they are its own, or the data files hold others."""
    episodes, frames = len(dataset.episodes), int(dataset.episodes.length.sum())
    about = checks.read_json(dataset.root / layout.INFO, "a dataset's description")
    counts = {"total_episodes": episodes, "total_frames": frames, "total_tasks": len(dataset.tasks)}
    rows = sum(pq.read_metadata(path).num_rows for path in dataset.root.glob(layout.DATA_FILES))
    right = {**about, **counts, "splits": {"train": f"0:{episodes}"}}
    return right if rows == frames and right != {"splits": right["splits"], **about} else {}


def _statistics(dataset: Dataset) -> dict[str, Any]:
    """Compute the statistics of every column of finite numbers, and from some pictures those of every camera."""
    stats: dict[str, Any] = {}
    for key, feature in dataset.features.items():
        if feature.dtype in NUMBERS:
            values = dataset.columns([key])[key].reshape(-1, feature.shape[-1] if feature.shape else 1)
            if np.isfinite(values).all():
                stats[key] = column_statistics({key: values})[key] | {"count": np.array([len(dataset)])}
        elif key in dataset.cameras and feature.is_rgb:
            stats[key] = picture_statistics(dataset, key)
    return {key: {name: numbers.tolist() for name, numbers in table.items()} for key, table in stats.items()}


def _write(path: Path, kept: Path, content: dict[str, Any]) -> str:
    if path.exists():
        kept.mkdir(exist_ok=True)
        shutil.copy2(path, kept / f"{path.name}")
    layout.write_json(path, content)
    return f"computed from the data: {path.parent.name}/{path.name}"
