"""One reading of all data files: what every check of rows and numbers needs, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.info import INDEX_FEATURES, NUMBERS, Info
from manip_il.data.parquet_limits import check_parquet
from manip_il.data.shards import UNREADABLE, BadColumn, Shard, to_array
from manip_il.doctor.finding import Finding, error, plural, some
from manip_il.doctor.moments import Moments

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Runs:
    """Rows in a row that belong to one episode, one entry a run. start: `index` of its first row."""

    episode: I64
    start: I64
    length: I64
    files: list[str]
    seeds: I64  # the episodes' seeds, where the dataset has such a column

    def __len__(self) -> int:
        return len(self.episode)


@dataclass
class Scan:
    """What reading all data files gave. moments: of every column of numbers that could be read in every file."""

    findings: list[Finding] = field(default_factory=list)
    runs: Runs = field(default_factory=lambda: _join([]))
    moments: dict[str, Moments] = field(default_factory=dict)
    tasks: set[int] = field(default_factory=set)
    readable: set[str] = field(default_factory=set)  # names of the files that were read to their end
    rows: int = 0


def scan(shards: Sequence[Shard], info: Info, quantiles: Mapping[str, F64], on_file: Callable[[], None]) -> Scan:
    """Read every file that has a footer, once. quantiles: those whose ranks are to be counted."""
    numbers = info.of_dtype(*NUMBERS)
    result = Scan(moments={feature.key: Moments(feature.size, quantiles.get(feature.key)) for feature in numbers})
    runs: list[Runs] = []
    try:
        check_parquet((shard.path for shard in shards if not shard.problem), list(result.moments))
    except UNREADABLE as problem:
        result.findings.append(error("data", f"cannot be read: {problem}"))
        return Scan(findings=result.findings)
    for shard in shards:
        if not shard.problem:
            runs += _scan_shard(shard, info, result)
        on_file()
    result.runs = _join(runs)
    return result


def _scan_shard(shard: Shard, info: Info, result: Scan) -> Iterator[Runs]:
    """Add what the file holds to `result`; nothing of it where it cannot be read to its end."""
    kept: dict[str, list[NDArray[Any]]] = {key: [] for key in (*INDEX_FEATURES, s.SEED)}
    rows, bad_columns = result.rows, set[str]()
    numbers = [key for key in result.moments if key in shard.columns]
    try:
        for table in shard.tables(numbers):
            for key in numbers:
                values = _checked(shard, info, table, key, bad_columns, result)
                if values is None:
                    continue
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
        del result.moments[key]  # named by the check of columns or above: no statistics of half a column
    whole = {key: np.concatenate(parts).reshape(-1) for key, parts in kept.items() if parts and key not in bad_columns}
    if layout.EPISODE_INDEX in whole:
        result.tasks |= set(np.unique(whole.get(layout.TASK_INDEX, np.zeros(0))).astype(int).tolist())
        yield _runs(shard, info, whole, result)


def _checked(
    shard: Shard, info: Info, table: pa.Table, key: str, bad_columns: set[str], result: Scan
) -> NDArray[Any] | None:
    if key in bad_columns:
        return None
    feature = info.features[key]
    try:
        return to_array(table.column(key), feature.dtype, feature.shape)
    except BadColumn as problem:
        bad_columns.add(key)
        result.findings.append(error(f"{shard.name}: {key}", str(problem)))
        return None


def _runs(shard: Shard, info: Info, columns: Mapping[str, NDArray[Any]], result: Scan) -> Runs:
    """The file's runs; what in them does not count as it should goes to `result.findings`."""
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
            result.findings += _not_as(shard, key, columns[key], wanted, tolerance, episode)
    seeds = columns[s.SEED][starts].astype(np.int64) if s.SEED in columns else np.zeros(0, dtype=np.int64)
    return Runs(episode[starts], index[starts], lengths, [shard.name] * len(starts), seeds)


def _not_as(
    shard: Shard, key: str, found: NDArray[Any], wanted: NDArray[Any], tolerance: Any, episode: I64
) -> Iterator[Finding]:
    with np.errstate(all="ignore"):
        bad = np.flatnonzero(~(np.abs(found.astype(np.float64) - wanted) <= tolerance))  # NaN is bad as well
    if len(bad):
        row = bad[0]
        where = f"in episode {episode[row]}, row {row:,} of the file"
        count = f"{plural(len(bad), 'row')} in {plural(len(np.unique(episode[bad])), 'episode')} like this"
        yield error(f"{shard.name}: {key}", f"{found[row]:.6g} {where}; expected {wanted[row]:.6g} ({count})")


def _join(runs: list[Runs]) -> Runs:
    def joined(name: str) -> I64:
        return np.concatenate([np.zeros(0, dtype=np.int64), *(getattr(run, name) for run in runs)])

    files = [file for run in runs for file in run.files]
    return Runs(joined("episode"), joined("start"), joined("length"), files, joined("seeds"))


def episodes_text(numbers: I64) -> str:
    """`episode 3`, `episodes 3, 7, 9 and 2 more`."""
    return f"episode{'' if len(numbers) == 1 else 's'} {some(numbers.tolist())}"
