"""Statistics of columns under LeRobot's names, in float64.

Statistics of an episode are exact: a quantile is the value of rank ceil(q T), whereas LeRobot uses
a histogram of 5,000 bins. Statistics of a dataset are pooled from its episodes as in LeRobot: min,
max, mean and std are exact, a quantile is the mean of the episodes' quantiles, weighted by their
frames.
"""

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
_LEVELS = np.arange(256)  # pixel values


def column_statistics(columns: Mapping[str, NDArray[Any]]) -> Statistics:
    """Return {column: {min, max, mean, std, count, q01, ...}} of numeric or boolean columns, (T,)
    or (T, d).

    Every statistic is (d,), except that `count` is (1,).
    """
    statistics: Statistics = {}
    for key, values in columns.items():
        rows = np.array(values.reshape(len(values), -1).T, np.float64, order="C")
        own = {
            "min": rows.min(axis=1),
            "max": rows.max(axis=1),
            "mean": rows.mean(axis=1),
            "std": rows.std(axis=1),
        }
        places = quantile_places(len(values))
        rows.partition(sorted(set(places.values())), axis=1)
        own |= {name: rows[:, place].copy() for name, place in places.items()}
        own["count"] = np.array([len(values)])
        statistics[key] = {name: own[name] for name in STAT_NAMES}
    return statistics


def picture_statistics(frames: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return the statistics of pictures (T, height, width, 3): values in [0, 1], one per
    channel, (3, 1, 1).
    """
    counts = np.zeros(3 * len(_LEVELS), np.int64)
    for frame in frames:
        counts += Image.fromarray(frame).histogram()
    counts = counts.reshape(3, len(_LEVELS))
    total, below = int(counts[0].sum()), counts.cumsum(axis=1)
    mean = counts @ _LEVELS / total
    places = {"min": 0, "max": total - 1, **quantile_places(total)}
    levels = {
        "mean": mean,
        "std": np.sqrt((counts * (_LEVELS - mean[:, None]) ** 2).sum(axis=1) / total),
        **{name: (below > place).argmax(axis=1) for name, place in places.items()},
    }
    shaped = {name: values.reshape(3, 1, 1) / 255 for name, values in levels.items()}
    return {
        name: np.array([len(frames)]) if name == "count" else shaped[name] for name in STAT_NAMES
    }


def quantile_places(count: int) -> dict[str, int]:
    """Return the index of each quantile in a sorted row of `count` values."""
    return {name: max(math.ceil(share * count), 1) - 1 for name, share in QUANTILES.items()}


def pool(one: Statistics, other: Statistics) -> Statistics:
    """Return the pooled statistics of the columns that two episodes or datasets share.

    Quantiles may be missing.

    Mean and std follow Chan et al. (1979), Updating formulae and a pairwise algorithm, eq. 2.1.
    """
    return {key: _pool(one[key], other[key]) for key in one if key in other}


def _pool(
    old: Mapping[str, NDArray[Any]], new: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    count = old["count"] + new["count"]
    share, apart = new["count"] / count, new["mean"] - old["mean"]
    spread = (
        (1 - share) * old["std"] ** 2 + share * new["std"] ** 2 + share * (1 - share) * apart**2
    )
    found = {"min": np.minimum(old["min"], new["min"]), "max": np.maximum(old["max"], new["max"])}
    found |= {"std": np.sqrt(spread), "count": count}
    means = [name for name in ("mean", *QUANTILES) if name in old and name in new]
    found |= {name: old[name] + share * (new[name] - old[name]) for name in means}
    return {name: found[name] for name in STAT_NAMES if name in found}


def to_lists(statistics: Statistics) -> dict[str, dict[str, list[Any]]]:
    """Return statistics as plain lists, as in `meta/stats.json`."""
    return {
        key: {name: values.tolist() for name, values in table.items()}
        for key, table in statistics.items()
    }


def read_statistics(root: Path) -> Statistics:
    """Read `meta/stats.json`; statistics of pictures are (channels, 1, 1).

    Raises `ManipError` if it is invalid.
    """
    path = root / STATS
    with reading(path):
        found = checks.read_json(path, "a dataset's statistics")
        return {
            key: {
                name: np.atleast_1d(np.asarray(values, np.float64))
                for name, values in table.items()
            }
            for key, table in found.items()
        }
