"""Files with one JSON record per line; a kill truncates at most the last line."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data.atomic import writing

Record = Mapping[str, Any]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return every record, except a truncated last line; [] if there is no file.

    Non-finite numbers are None. Raises `ManipError` naming any other line that is not a JSON object.
    """
    lines = checks.read_bytes(path, "JSON lines").splitlines(keepends=True) if path.exists() else []
    whole = [line for line in lines if line.endswith(b"\n")]
    names = (f"{path}, line {number}" for number in itertools.count(1))
    return [checks.mapping(name, checks.parse_json(name, line)) for name, line in zip(names, whole, strict=False)]


def append_line(path: Path, record: Record) -> None:
    """Append a record, replacing a truncated last line; non-finite numbers at its top level become null."""
    line = json.dumps(_finite(record), allow_nan=False, default=_plain).encode() + b"\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with writing(path), open(path, "ab+", opener=checks.without_link) as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)
        file.write(line)
        file.flush()  # inside `writing`, which reports a full disk


def _finite(record: Record) -> dict[str, Any]:
    return {key: None if isinstance(one, float) and not math.isfinite(one) else one for key, one in record.items()}


def _plain(value: Any) -> Any:
    """Return a numpy scalar, an array or a path as a JSON value."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
