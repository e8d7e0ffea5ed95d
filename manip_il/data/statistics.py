"""Statistics of columns under LeRobot's names, in float64.

Statistics of an episode are exact: a quantile is the value of rank ceil(q T), whereas LeRobot uses a histogram of
5,000 bins. Statistics of a dataset are pooled from its episodes as in LeRobot: min, max, mean and std are exact, a
quantile is the mean of the episodes' quantiles, weighted by their frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.data.info import reading
from manip_il.data.lerobot_layout import QUANTILES, STAT_NAMES, STATS

Statistics = dict[str, dict[str, NDArray[Any]]]  # column -> name -> one value per dimension
F64 = NDArray[np.float64]
_POOLED = tuple(name for name in STAT_NAMES if name != "count")
_LEVELS = np.arange(256)  # pixel values


def column_statistics(columns: Mapping[str, NDArray[Any]]) -> Statistics:
    """Return {column: {min, max, mean, std, count, q01, ...}} of numbers or booleans (T,) or (T, d), (d,) each."""
    flat = {key: values.reshape(len(values), -1) for key, values in columns.items()}
    rows = np.ascontiguousarray(np.concatenate(list(flat.values()), axis=1, dtype=np.float64, casting="unsafe").T)
    count = rows.shape[1]
    found = {"min": rows.min(axis=1), "max": rows.max(axis=1), "mean": rows.mean(axis=1), "std": rows.std(axis=1)}
    places = quantile_places(count)
    rows.partition(sorted(set(places.values())), axis=1)
    found |= {name: rows[:, place].copy() for name, place in places.items()}
    found["count"] = np.full(len(rows), count)
    statistics: Statistics = {}
    start = 0
    for key, values in flat.items():
        stop = start + values.shape[1]
        statistics[key] = {name: found[name][start : start + 1 if name == "count" else stop] for name in STAT_NAMES}
        start = stop
    return statistics


def picture_statistics(frames: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return the statistics of pictures (T, height, width, 3): values in [0, 1], one per channel, (3, 1, 1)."""
    counts = np.zeros(3 * len(_LEVELS), np.int64)
    for frame in frames:
        counts += Image.fromarray(frame).histogram()
    counts = counts.reshape(3, len(_LEVELS))
    total, below = int(counts[0].sum()), counts.cumsum(axis=1)
    mean = counts @ _LEVELS / total
    levels = {
        "min": (counts > 0).argmax(axis=1),
        "max": _LEVELS[-1] - (counts[:, ::-1] > 0).argmax(axis=1),
        "mean": mean,
        "std": np.sqrt((counts * (_LEVELS - mean[:, None]) ** 2).sum(axis=1) / total),
        **{name: (below > place).argmax(axis=1) for name, place in quantile_places(total).items()},
    }
    shaped = {name: values.reshape(3, 1, 1) / 255 for name, values in levels.items()}
    return {name: np.array([len(frames)]) if name == "count" else shaped[name] for name in STAT_NAMES}


def quantile_places(count: int) -> dict[str, int]:
    """Return the index of each quantile in a sorted row of `count` values."""
    return {name: max(math.ceil(share * count), 1) - 1 for name, share in QUANTILES.items()}


class PooledStatistics:
    """Pooled statistics of episodes or datasets with the same columns; quantiles may be missing."""

    def __init__(self) -> None:
        self._first: Statistics = {}
        self._sums: dict[str, F64] = {}  # statistic -> values of all columns, concatenated
        self._count = 0

    def add(self, episode: Statistics) -> None:
        """Add the statistics of one episode or dataset.

        Mean and std follow Chan et al. (1979), Updating formulae and a pairwise algorithm, eq. 2.1.
        """
        names = [name for name in _POOLED if all(name in one for one in episode.values())]
        new = {name: np.concatenate([one[name].ravel() for one in episode.values()]) for name in names}
        more = int(next(iter(episode.values()))["count"][0])
        old, self._count = self._sums, self._count + more
        if not old:
            self._first, self._sums = episode, new
            return
        share = more / self._count
        apart = new["mean"] - old["mean"]
        spread = (1 - share) * old["std"] ** 2 + share * new["std"] ** 2 + share * (1 - share) * apart**2
        means = [name for name in ("mean", *QUANTILES) if name in old and name in new]
        self._sums = {name: old[name] + share * (new[name] - old[name]) for name in means} | {
            "min": np.minimum(old["min"], new["min"]),
            "max": np.maximum(old["max"], new["max"]),
            "std": np.sqrt(spread),
        }

    def result(self) -> Statistics:
        """Return the statistics of all frames."""
        statistics: Statistics = {}
        start = 0
        for key, one in self._first.items():
            shape, size = one["mean"].shape, one["mean"].size
            own = {name: values[start : start + size].reshape(shape) for name, values in self._sums.items()}
            own["count"] = np.array([self._count])
            statistics[key] = {name: own[name] for name in STAT_NAMES if name in own}
            start += size
        return statistics


def to_lists(statistics: Statistics) -> dict[str, dict[str, list[Any]]]:
    """Return statistics as plain lists, as in `meta/stats.json`."""
    return {key: {name: values.tolist() for name, values in table.items()} for key, table in statistics.items()}


def read_statistics(root: Path) -> Statistics:
    """Read `meta/stats.json`; statistics of pictures are (channels, 1, 1). Raises `ManipError` if it is invalid."""
    path = root / STATS
    with reading(path):
        found = checks.read_json(path, "a dataset's statistics")
        return {
            key: {name: np.atleast_1d(np.asarray(values, np.float64)) for name, values in table.items()}
            for key, table in found.items()
        }
