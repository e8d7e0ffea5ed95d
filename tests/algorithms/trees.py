"""Runs on disk, compared."""

from __future__ import annotations

import hashlib
from pathlib import Path


def files(folder: Path) -> dict[str, str]:
    """Name -> hash of its content."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def is_data(name: str) -> bool:
    """Whether a file's bytes must not depend on where and when it was made."""
    return name.endswith((".parquet", ".mcap", ".safetensors", "eval.json"))
