"""Check what `meta/episodes` says that episodes drew."""

from __future__ import annotations

from collections.abc import Iterator

from manip_il.data import lerobot_layout as layout
from manip_il.data.draws import from_text
from manip_il.data.parquet_files import UNREADABLE
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, error, plural
from manip_il.errors import ManipError


def check_draws(dataset: Dataset) -> Iterator[Finding]:
    """Check that each episode's draws are a JSON object; datasets of other programs, and older ones, have none."""
    for shard in dataset.episode_shards if dataset.is_ours else []:
        if shard.problem or layout.DRAWN not in shard.columns:
            continue
        try:
            texts = [text for table in shard.tables([layout.DRAWN]) for text in table.column(0).to_pylist()]
        except UNREADABLE:
            continue  # reported by the check of episodes
        if wrong := [problem for row, text in enumerate(texts) if (problem := _problem(row, text))]:
            yield error(f"{shard.name}: {layout.DRAWN}", f"{wrong[0]} ({plural(len(wrong), 'row')} like this)")


def _problem(row: int, text: object) -> str:
    try:
        from_text(f"row {row}", text)
    except ManipError as problem:
        return str(problem)
    return ""
