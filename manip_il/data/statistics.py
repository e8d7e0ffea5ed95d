"""Statistics of columns under LeRobot's names, in float64 and exact.

LeRobot computes in the column's own float32 (mean of squares minus square of the mean) and reads quantiles off a
histogram of 5,000 bins; those of a dataset are means over its episodes' quantiles, which is not a quantile. Here a
quantile is the value of rank ceil(q T), which LeRobot's histogram approximates, in one episode and over all frames.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.data.info import NUMBERS, PICTURES, Feature, Info, read_object
from manip_il.data.lerobot_layout import QUANTILES, STAT_NAMES, STATS
from manip_il.errors import ManipError

F64 = NDArray[np.float64]
Stats = dict[str, dict[str, list[float]]]  # column -> name -> one value a dimension
Statistics = dict[str, dict[str, NDArray[Any]]]  # the same as arrays
I64 = NDArray[np.int64]
_LEVELS = np.arange(256)  # of a pixel
_BLOCK_BYTES = 16 * 1024 * 1024  # of a dataset's numbers held at once
_GROUP_BYTES = 4 * 1024 * 1024  # of episodes that are written together, so that reading one dimension is few reads


class RunningStats:
    """Statistics of every episode and, in the end, of all their frames, in memory that does not grow.

    Quantiles need all numbers at once: till then they wait in a file of the folder that has no name, eight bytes each.
    """

    def __init__(self, folder: Path):
        self._numbers = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # open until `close`
        self._widths: dict[str, int] = {}
        self._waiting: list[F64] = []  # episodes, each (dimensions, T)
        self._waiting_bytes = 0
        self._lengths: list[int] = []  # frames of every group that is written

    def add(self, columns: Mapping[str, NDArray[Any]]) -> Stats:
        """Return {column: {min, max, mean, std, count, q01, ...}} of one episode, one value a dimension.

        columns: name -> (T,) or (T, d) numbers or booleans, all of the same T; the same names and d every time.
        """
        flat = {key: values.reshape(len(values), -1) for key, values in columns.items()}
        matrix = np.concatenate(list(flat.values()), axis=1, dtype=np.float64, casting="unsafe")
        rows = np.ascontiguousarray(matrix.T)
        self._widths = {key: values.shape[1] for key, values in flat.items()}
        self._waiting.append(rows)
        self._waiting_bytes += rows.nbytes
        if self._waiting_bytes >= _GROUP_BYTES:
            self._write()
        return self._named(_row_stats(rows.copy()), len(matrix))

    def result(self) -> Stats:
        """Return the same of all frames so far."""
        if self._waiting:
            self._write()
        self._numbers.flush()
        frames, width = sum(self._lengths), sum(self._widths.values())
        step = max(1, _BLOCK_BYTES // (8 * frames))
        blocks = (self._block(start, min(start + step, width), frames) for start in range(0, width, step))
        single = [_row_stats(row[None]) for block in blocks for row in block]
        return self._named({name: np.concatenate([stats[name] for stats in single]) for name in single[0]}, frames)

    def close(self) -> None:
        """Let go of the file."""
        self._numbers.close()

    def _write(self) -> None:
        """Append the episodes that wait, dimension by dimension."""
        group = np.concatenate(self._waiting, axis=1)
        self._numbers.write(group.data)
        self._lengths.append(group.shape[1])
        self._waiting, self._waiting_bytes = [], 0

    def _block(self, start: int, stop: int, frames: int) -> F64:
        """Dimensions `start` to `stop - 1` of all frames, (stop - start, frames)."""
        block = np.empty((stop - start, frames))
        width, at = sum(self._widths.values()), 0
        for length in self._lengths:
            numbers = os.pread(self._numbers.fileno(), 8 * (stop - start) * length, 8 * (width * at + start * length))
            block[:, at : at + length] = np.frombuffer(numbers).reshape(-1, length)
            at += length
        return block

    def _named(self, numbers: Mapping[str, F64], count: int) -> Stats:
        stats: Stats = {}
        start = 0
        for key, width in self._widths.items():
            own = {name: values[start : start + width].tolist() for name, values in numbers.items()}
            own["count"] = [count]
            stats[key] = {name: own[name] for name in STAT_NAMES}
            start += width
        return stats


def pixel_counts(frames: NDArray[np.uint8]) -> I64:
    """Return how often every channel has every level, (3, 256), in frames (T, height, width, 3).

    Those of several episodes add up to those of all of them.
    """
    counts = np.zeros(3 * 256, dtype=np.int64)
    for frame in frames:
        counts += Image.fromarray(frame).histogram()
    return counts.reshape(3, 256)


def picture_stats(counts: I64, frames: int) -> dict[str, list[Any]]:
    """Return statistics of pictures from their `pixel_counts`: levels in [0, 1], one a channel as (3, 1, 1)."""
    total, below = int(counts[0].sum()), counts.cumsum(axis=1)
    first, second = (counts @ _LEVELS).tolist(), (counts @ _LEVELS**2).tolist()  # Python's integers: nothing is rounded
    stats: dict[str, list[float]] = {
        "min": (counts > 0).argmax(axis=1).tolist(),
        "max": (len(_LEVELS) - 1 - (counts[:, ::-1] > 0).argmax(axis=1)).tolist(),
        "mean": [one / total for one in first],
        "std": [math.sqrt(total * two - one**2) / total for one, two in zip(first, second, strict=True)],
        **{name: (below > rank).argmax(axis=1).tolist() for name, rank in quantile_places(total).items()},
    }
    shaped: dict[str, list[Any]] = {name: [[[value / 255]] for value in values] for name, values in stats.items()}
    shaped["count"] = [frames]
    return {name: shaped[name] for name in STAT_NAMES}


def _row_stats(rows: F64) -> dict[str, F64]:
    """Of every row of (D, T), which are sorted in part afterwards."""
    if rows.shape[1] == 1:  # a frame by itself
        value = rows[:, 0].copy()
        return dict.fromkeys(("min", "max", "mean", *QUANTILES), value) | {"std": np.zeros_like(value)}
    moments = {"min": rows.min(axis=1), "max": rows.max(axis=1), "mean": rows.mean(axis=1), "std": rows.std(axis=1)}
    ranks = quantile_places(rows.shape[1])
    rows.partition(sorted(set(ranks.values())), axis=1)
    return {**moments, **{name: rows[:, rank].copy() for name, rank in ranks.items()}}


def quantile_places(count: int) -> dict[str, int]:
    """Return where in a sorted row of `count` values each quantile stands, from 0."""
    return {name: max(int(np.ceil(share * count)), 1) - 1 for name, share in QUANTILES.items()}


def column_statistics(columns: Mapping[str, NDArray[Any]]) -> Statistics:
    """Return the statistics of columns, (T,) or (T, d), for a dataset that has none."""
    with tempfile.TemporaryDirectory() as folder:
        running = RunningStats(Path(folder))
        running.add(columns)
        found = running.result()
        running.close()
    return {key: {name: np.asarray(values) for name, values in table.items()} for key, table in found.items()}


def read_statistics(root: Path, info: Info) -> Statistics:
    """Read `meta/stats.json`: column -> name -> numbers, (n,), of pictures (channels, 1, 1).

    Raises `ManipError` for a statistic that is missing, that is not numbers, or that is not of the column's shape.
    """
    path = root / STATS
    try:
        found = read_object(path)
    except (OSError, ValueError) as error:
        raise ManipError(f"cannot read {path}: {error}; `manip-il doctor --repair=true` computes it again") from error
    known = [feature for feature in info.of_dtype(*NUMBERS, *PICTURES) if feature.key in found]
    return {feature.key: _statistics(path, feature, found[feature.key]) for feature in known}


def _statistics(path: Path, feature: Feature, table: Any) -> dict[str, NDArray[Any]]:
    shapes = {(feature.size,), feature.shape[-1:], feature.shape}
    if feature.dtype in PICTURES:
        shapes = {(count, 1, 1) for count in feature.shape}  # the names of its axes may be missing
    statistics: dict[str, NDArray[Any]] = {}
    for name in STAT_NAMES:
        value = table.get(name) if isinstance(table, dict) else None
        if value is None and name in QUANTILES:
            continue
        wanted = {(1,)} if name == "count" else shapes
        try:
            numbers = np.atleast_1d(np.asarray(value))
        except (ValueError, OverflowError):
            numbers = np.zeros(0, object)
        if numbers.dtype.kind not in "iuf" or numbers.shape not in wanted:
            shape = " or ".join(map(str, sorted(wanted)))
            what = f"{name} of {feature.key} is {checks.shorten(value)}"
            raise ManipError(f"{path}: {what}; expected numbers of shape {shape} (`manip-il doctor` tells more)")
        statistics[name] = numbers
    return statistics
