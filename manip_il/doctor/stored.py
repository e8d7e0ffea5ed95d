"""What `meta/stats.json` says, as arrays; anything that is not a number there is nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from manip_il.data.info import Feature
from manip_il.data.lerobot_layout import QUANTILES

F64 = NDArray[np.float64]


def stored(stats: Mapping[str, Any] | None, key: str, name: str) -> F64 | None:
    """Return one statistic of one feature, flat; None where it is missing or not of finite numbers."""
    table = (stats or {}).get(key)
    if not isinstance(table, dict) or name not in table:
        return None
    try:
        values = np.asarray(cast(dict[str, Any], table)[name], dtype=np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        return None
    return values if np.isfinite(values).all() else None


def stored_quantiles(stats: Mapping[str, Any] | None, features: Iterable[Feature]) -> dict[str, F64]:
    """Return column -> its quantiles, (Q, numbers of a frame), where all of them are there."""
    found: dict[str, F64] = {}
    for feature in features:
        rows = [stored(stats, feature.key, name) for name in QUANTILES]
        if all(row is not None and len(row) == feature.size for row in rows):
            found[feature.key] = np.array(rows)
    return found
