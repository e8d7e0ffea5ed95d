"""Statistics of columns under LeRobot's names, in float64 and exact.

LeRobot computes in the column's own float32 (mean of squares minus square of the mean) and reads quantiles off a
histogram of 5,000 bins; those of a dataset are means over its episodes' quantiles, which is not a quantile. Here a
quantile is the value of rank ceil(q T), which LeRobot's histogram approximates, in one episode and over all frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data.lerobot_layout import QUANTILES, STAT_NAMES

F64 = NDArray[np.float64]


def column_stats(columns: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, list[float]]]:
    """Statistics {column: {min, max, mean, std, count, q01, ...: one value a dimension}} over frames.

    columns: name -> (T,) or (T, d) numbers or booleans, all of the same T.
    """
    flat = {key: values.reshape(len(values), -1) for key, values in columns.items()}
    matrix = np.concatenate(list(flat.values()), axis=1, dtype=np.float64, casting="unsafe")
    results = _matrix_stats(np.ascontiguousarray(matrix.T))
    stats: dict[str, dict[str, list[float]]] = {}
    start = 0
    for key, values in flat.items():
        stop = start + values.shape[1]
        stats[key] = {name: results[name][start:stop].tolist() for name in STAT_NAMES if name != "count"}
        stats[key]["count"] = [len(values)]
        start = stop
    return {key: {name: values[name] for name in STAT_NAMES} for key, values in stats.items()}


def _matrix_stats(rows: F64) -> dict[str, F64]:
    """Of every row of (D, T)."""
    count = rows.shape[1]
    ranks = {name: max(int(np.ceil(share * count)), 1) - 1 for name, share in QUANTILES.items()}
    ordered = np.partition(rows, sorted(set(ranks.values())), axis=1)
    return {
        "min": rows.min(axis=1),
        "max": rows.max(axis=1),
        "mean": rows.mean(axis=1),
        "std": rows.std(axis=1),
        **{name: ordered[:, rank] for name, rank in ranks.items()},
    }
