"""Content of a dataset's folder, read once; a damaged file does not keep the others from being read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from manip_il.data import dataset as data
from manip_il.data import lerobot_layout as layout
from manip_il.data.dataset import Own
from manip_il.data.episode_table import EpisodeTable, concatenate, read_rows
from manip_il.data.info import NUMBERS, Info, InvalidInfo, read_info, read_object
from manip_il.data.parquet_files import UNREADABLE, BadColumn, Shard, find_shards
from manip_il.doctor.finding import Finding, error
from manip_il.doctor.scan import F64, Scan, scan
from manip_il.errors import ManipError


@dataclass(frozen=True)
class Patient:
    """Content of a folder. on_file is called after every data file, video and journal."""

    root: Path
    on_file: Callable[[], None] = field(default=lambda: None, compare=False)

    @property
    def info(self) -> Info | None:
        """Content of `meta/info.json`; None where it cannot be used."""
        return self._info if isinstance(self._info, Info) else None

    @property
    def info_problems(self) -> list[str]:
        """Lines that say why `meta/info.json` cannot be used."""
        return [] if isinstance(self._info, Info) else self._info.problems

    @cached_property
    def _info(self) -> Info | InvalidInfo:
        try:
            return read_info(self.root)
        except InvalidInfo as invalid:
            return invalid

    @cached_property
    def own(self) -> Own | None:
        """Content of this program's own file; None if there is none. Raises `ManipError` if it cannot be read."""
        return None if self.info is None else data.Dataset(self.root, self.info).own

    @property
    def is_ours(self) -> bool:
        """Whether this program wrote it."""
        return (self.root / layout.OURS).exists()

    @property
    def journals(self) -> Path:
        """Folder of the dataset's journals, beside it; it may be missing."""
        root = self.root.absolute()
        return root.with_name(f"{root.name}.journals")

    @cached_property
    def data_shards(self) -> list[Shard]:
        """Data files that LeRobot reads: all that match its pattern, whether or not an episode names them."""
        return find_shards(self.root, layout.DATA_FILES)

    @cached_property
    def episode_shards(self) -> list[Shard]:
        """Files of `meta/episodes`."""
        return find_shards(self.root, layout.EPISODES_FILES)

    @property
    def episodes(self) -> EpisodeTable | None:
        """Readable rows of `meta/episodes`; None where there are none."""
        return self._episodes[0]

    @property
    def episode_findings(self) -> list[Finding]:
        """Damage behind the footers of `meta/episodes`: columns and pages."""
        return self._episodes[1]

    @cached_property
    def _episodes(self) -> tuple[EpisodeTable | None, list[Finding]]:
        parts: list[EpisodeTable] = []
        findings: list[Finding] = []
        for shard in self.episode_shards:
            if self.info is None or shard.problem:
                continue
            try:
                parts += read_rows(shard, self.info)
            except (BadColumn, ManipError) as problem:
                findings.append(error(shard.name, str(problem)))
            except UNREADABLE as problem:
                findings.append(error(shard.name, f"cannot be read: {problem}"))
        return (concatenate(parts) if parts else None), findings

    @property
    def reads_all_episodes(self) -> bool:
        """Whether every row of `meta/episodes` can be read."""
        return not self.episode_findings and not any(shard.problem for shard in self.episode_shards)

    @property
    def knows_all_episodes(self) -> bool:
        """Whether `meta/episodes` can be read and holds as many episodes as `meta/info.json` counts."""
        if self.info is None or self.episodes is None:
            return False
        return self.reads_all_episodes and len(self.episodes) == self.info.episodes

    @cached_property
    def scan(self) -> Scan:
        """Result of reading all data files once."""
        if self.info is None:
            return Scan()
        quantiles: dict[str, F64] = {}
        for feature in self.info.of_dtype(*NUMBERS) if self.is_ours else []:
            rows = [self.statistic(feature.key, name) for name in layout.QUANTILES]
            if all(row is not None and len(row) == feature.size for row in rows):
                quantiles[feature.key] = np.array(rows)
        return scan(self.data_shards, self.info, quantiles, self.on_file)

    @property
    def reads_all_rows(self) -> bool:
        """Whether there are data files and each of them can be read to its end."""
        return bool(self.data_shards) and len(self.scan.readable) == len(self.data_shards)

    @cached_property
    def stats(self) -> dict[str, Any] | None:
        """Content of `meta/stats.json`; None where it cannot be read."""
        try:
            return read_object(self.root / layout.STATS)
        except (OSError, ValueError, RecursionError):
            return None

    def statistic(self, key: str, name: str) -> F64 | None:
        """Return a column's statistic in `meta/stats.json`, flat, (n,); None for all but finite numbers."""
        table: Any = (self.stats or {}).get(key)
        if not isinstance(table, dict) or name not in table:
            return None
        try:
            values = np.asarray(cast(dict[str, Any], table)[name], dtype=np.float64).reshape(-1)
        except (TypeError, ValueError, OverflowError):
            return None
        return values if np.isfinite(values).all() else None
