"""Runs on disk, compared."""

from __future__ import annotations

import hashlib
from pathlib import Path


def files(folder: Path) -> dict[str, str]:
    """Name -> hash of its content."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def check_same_data(run: Path, other: Path) -> None:
    """Check that two runs have the same files, of which those of data have the same bytes."""
    ours, theirs = files(run), files(other)
    assert ours.keys() == theirs.keys()
    data = [name for name in ours if name.endswith((".parquet", ".mcap", ".safetensors", "eval.json"))]
    assert [ours[name] for name in data] == [theirs[name] for name in data]
