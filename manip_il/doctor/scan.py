"""Read all data files once: episodes, index columns and exact statistics of every column, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.episode_table import concatenate
from manip_il.data.info import INDEX_FEATURES, NUMBERS, Info
from manip_il.data.parquet_files import UNREADABLE, BadColumn, Shard, to_numpy
from manip_il.doctor.finding import Finding, error, plural

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


class Moments:
    """Statistics of a column, added up piece by piece in float64, in memory of one row.

    Not `RunningStats`, which computes the quantiles themselves and for that writes every number to a file of the
    dataset's folder: a check writes nothing, and that a quantile is right shows in two counts.

    size: n, numbers of a row. quantiles: (Q, n), whose ranks are counted; `below` and `up_to`, (Q, n), count the
    numbers below each of them, and those that are not above it.
    """

    def __init__(self, size: int, quantiles: F64 | None = None):
        self.quantiles = np.zeros((0, size)) if quantiles is None else quantiles
        self.rows = 0
        self.bad_rows = 0  # with a number that is not finite
        self.first_bad: tuple[int, float] | None = None  # row in the dataset, value
        self.low, self.high = np.full(size, np.inf), np.full(size, -np.inf)
        self.mean, self.squares = np.zeros(size), np.zeros(size)  # squares: sum of squared distances from the mean
        self.below, self.up_to = (np.zeros(self.quantiles.shape, dtype=np.int64) for _ in range(2))

    def add(self, values: NDArray[Any], first_row: int) -> None:
        """Add the next rows, (T, n) numbers, which are the dataset's from `first_row` on."""
        if not values.size:
            return
        values = values.astype(np.float64)
        finite = np.isfinite(values)
        if not finite.all():
            bad = np.flatnonzero(~finite.all(axis=1))
            if self.first_bad is None:
                row = int(bad[0])
                self.first_bad = first_row + row, float(values[row][~finite[row]][0])
            self.bad_rows += len(bad)
            return  # of a column with such numbers no statistics are compared
        with np.errstate(all="ignore"):
            self._merge(values)
        for number, quantile in enumerate(self.quantiles):
            self.below[number] += (values < quantile).sum(axis=0)
            self.up_to[number] += (values <= quantile).sum(axis=0)

    @property
    def std(self) -> F64:
        """Standard deviation, (n,)."""
        return np.sqrt(self.squares / max(self.rows, 1))

    def over_last_axis(self, shape: tuple[int, ...]) -> Moments:
        """Merge the numbers of equal index on the last axis of `shape`: LeRobot's statistics of a matrix, (n,)."""
        merged = Moments(shape[-1])
        with np.errstate(all="ignore"):
            means, squares = self.mean.reshape(-1, shape[-1]), self.squares.reshape(-1, shape[-1])
            merged.low = self.low.reshape(-1, shape[-1]).min(axis=0)
            merged.high = self.high.reshape(-1, shape[-1]).max(axis=0)
            merged.mean = means.mean(axis=0)
            merged.squares = (squares + self.rows * (means - merged.mean) ** 2).sum(axis=0)
        merged.rows = self.rows * len(means)
        return merged

    def _merge(self, values: F64) -> None:
        """Chan, Golub and LeVeque (1983), their pairwise update."""
        count, mean = len(values), values.mean(axis=0)
        total, shift = self.rows + count, mean - self.mean
        self.squares += ((values - mean) ** 2).sum(axis=0) + shift**2 * (self.rows * count / total)
        self.mean += shift * (count / total)
        self.low, self.high = np.minimum(self.low, values.min(axis=0)), np.maximum(self.high, values.max(axis=0))
        self.rows = total


@dataclass(frozen=True)
class Runs:
    """Successive rows of one episode in one file, one entry a run. start: `index` of its first row."""

    episode: I64
    start: I64
    length: I64
    files: list[str]
    seeds: I64  # of the episodes; empty where the dataset has no such column

    def __len__(self) -> int:
        return len(self.episode)


_NONE = np.zeros(0, dtype=np.int64)
_NO_RUNS = Runs(_NONE, _NONE, _NONE, [], _NONE)


@dataclass
class Scan:
    """Result of reading all data files. moments: of every column of numbers that could be read in every file."""

    findings: list[Finding] = field(default_factory=list[Finding])
    runs: Runs = _NO_RUNS
    moments: dict[str, Moments] = field(default_factory=dict[str, Moments])
    tasks: set[int] = field(default_factory=set[int])
    readable: set[str] = field(default_factory=set[str])  # names of the files that were read to their end
    rows: int = 0


def scan(shards: Sequence[Shard], info: Info, quantiles: Mapping[str, F64], on_file: Callable[[], None]) -> Scan:
    """Read every file that has a footer, once. quantiles: column -> (Q, n), those whose ranks are counted."""
    numbers = info.of_dtype(*NUMBERS)
    result = Scan(moments={feature.key: Moments(feature.size, quantiles.get(feature.key)) for feature in numbers})
    runs = [result.runs]
    for shard in shards:
        if not shard.problem:
            runs += _scan_shard(shard, info, result)
        on_file()
    result.runs = concatenate(runs)
    return result


def _scan_shard(shard: Shard, info: Info, result: Scan) -> Iterator[Runs]:
    """Add a file to `result`, and yield its runs where it can be read to its end."""
    kept: dict[str, list[NDArray[Any]]] = {key: [] for key in (*INDEX_FEATURES, s.SEED)}
    rows, bad_columns = result.rows, set[str]()
    numbers = [key for key in result.moments if key in shard.columns]
    try:
        for table in shard.tables(numbers):
            for key in numbers:
                if key in bad_columns:
                    continue
                try:
                    values = to_numpy(table.column(key), info.features[key].dtype, info.features[key].shape, exact=True)
                except BadColumn as problem:
                    bad_columns.add(key)
                    result.findings.append(error(f"{shard.name}: {key}", str(problem)))
                    continue
                values = values.reshape(len(values), -1)
                result.moments[key].add(values, rows)
                if key in kept:
                    kept[key].append(values)
            rows += len(table)
    except UNREADABLE as problem:
        result.findings.append(error(shard.name, f"cannot be read: {problem}"))
        return
    result.rows = rows
    result.readable.add(shard.name)
    for key in [key for key in result.moments if key in bad_columns or key not in shard.columns]:
        del result.moments[key]  # reported here or by the check of columns: no statistics of half a column
    whole = {key: np.concatenate(parts).reshape(-1) for key, parts in kept.items() if parts and key not in bad_columns}
    if layout.EPISODE_INDEX in whole:
        result.tasks |= set(np.unique(whole.get(layout.TASK_INDEX, np.zeros(0))).astype(int).tolist())
        yield _find_runs(shard, info, whole, result)


def _find_runs(shard: Shard, info: Info, columns: Mapping[str, NDArray[Any]], result: Scan) -> Runs:
    """Return the file's runs; index columns with wrong values are added to `result.findings`."""
    episode = columns[layout.EPISODE_INDEX].astype(np.int64)
    starts = np.flatnonzero(np.diff(episode, prepend=episode[:1] - 1))
    lengths = np.diff(np.append(starts, len(episode)))
    offset = np.arange(len(episode)) - np.repeat(starts, lengths)
    index = columns.get(layout.INDEX, np.arange(len(episode))).astype(np.int64)
    time = offset / info.fps
    expected = {
        layout.FRAME_INDEX: (offset, 0.0),
        layout.INDEX: (np.repeat(index[starts], lengths) + offset, 0.0),
        # LeRobot's tolerance, and what float32 leaves of a long episode's last digits
        layout.TIMESTAMP: (time, 1e-4 + 1e-6 * time),
    }
    for key, (wanted, tolerance) in expected.items():
        if key in columns:
            result.findings += _compare(shard, key, columns[key], wanted, tolerance, episode)
    seeds = columns[s.SEED][starts].astype(np.int64) if s.SEED in columns else _NONE
    return Runs(episode[starts], index[starts], lengths, [shard.name] * len(starts), seeds)


def _compare(
    shard: Shard, key: str, found: NDArray[Any], wanted: NDArray[Any], tolerance: Any, episode: I64
) -> Iterator[Finding]:
    with np.errstate(all="ignore"):
        bad = np.flatnonzero(~(np.abs(found.astype(np.float64) - wanted) <= tolerance))  # NaN is bad as well
    if len(bad):
        row = bad[0]
        place = f"in episode {episode[row]}, row {row:,} of the file"
        count = f"{plural(len(bad), 'row')} in {plural(len(np.unique(episode[bad])), 'episode')} like this"
        yield error(f"{shard.name}: {key}", f"{found[row]:.6g} {place}; expected {wanted[row]:.6g} ({count})")
