"""Draws of a dataset's episodes: text in `meta/episodes`, one JSON object an episode, `{}` for nothing.

LeRobot's merge keeps the column, its split and delete drop it; every frame's `sim_state` has the draws all the same.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.parquet_files import find_shards, read_file
from manip_il.errors import ManipError


def to_text(drawn: Mapping[str, Any]) -> str:
    """Return an episode's draws, by the names of their ranges, as JSON."""
    return json.dumps(dict(drawn))


def from_text(what: str, text: Any) -> dict[str, Any]:
    """Return the inverse of `to_text`; of no text nothing. Raises `ManipError` naming `what` for anything else."""
    if text is None:  # as in the rows of a dataset that was merged with one that has none
        return {}
    return dict(checks.mapping(what, checks.parse_json(what, checks.text(what, text))))


def read_drawn(root: Path) -> dict[int, dict[str, Any]]:
    """Return what the episodes drew, by their index; those of datasets from before are left out.

    Raises `ManipError` for a file that cannot be read.
    """
    found: dict[int, dict[str, Any]] = {}
    for shard in find_shards(root, layout.EPISODES_FILES):
        if layout.DRAWN not in shard.columns:
            continue
        table = read_file(shard.path, [layout.EPISODE_INDEX, layout.DRAWN])
        for index, text in zip(*(table.column(name).to_pylist() for name in table.column_names), strict=True):
            if not isinstance(index, int):
                raise ManipError(f"{shard.path}: {layout.EPISODE_INDEX} is {checks.shorten(index)}; expected a number")
            found[index] = from_text(f"{shard.path}: {layout.DRAWN} of episode {index}", text)
    return found


def summary(drawn: Iterable[Mapping[str, Any]]) -> str:
    """Return the ranges that numbers were drawn from, and what was drawn of words; the names alone of anything else."""
    values: dict[str, list[Any]] = {}
    for one in drawn:
        for name, value in one.items():
            values.setdefault(name, []).append(value)
    return ", ".join(name + _span(found) for name, found in sorted(values.items()))


def _span(values: list[Any]) -> str:
    if all(isinstance(value, str) for value in values):
        return f" {' or '.join(sorted(set(values)))}"
    if not all(isinstance(value, int | float) for value in values):
        return ""
    low, high = min(values), max(values)
    return f" {low:.3g}" if low == high else f" {low:.3g} to {high:.3g}"
