"""Checks of what stands once a dataset: info.json, tasks, the list of episodes, readable footers."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any, cast

import numpy as np
import pyarrow as pa

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import INDEX_FEATURES, PICTURES, Info
from manip_il.data.shards import UNREADABLE, BadColumn, integers, open_shard
from manip_il.doctor.dataset import Dataset, Episodes
from manip_il.doctor.finding import Finding, error, plural, some

EPISODES = "meta/episodes"


def check_info(dataset: Dataset) -> Iterator[Finding]:
    """Check that `meta/info.json` can be used, has the columns of every dataset, and names for each number."""
    for text in dataset.info_problems:
        yield error(layout.INFO, text)
    if dataset.info is None:
        return
    if missing := [key for key in INDEX_FEATURES if key not in dataset.info.features]:
        yield error(layout.INFO, f"features lack {', '.join(missing)}, which every LeRobot dataset has")
    yield from _check_names(dataset.info)


def check_footers(dataset: Dataset) -> Iterator[Finding]:
    """Yield every parquet file of data and of episodes is there and has a readable footer."""
    info = dataset.info
    for pattern, shards in ((layout.DATA_FILES, dataset.data_shards), (layout.EPISODES_FILES, dataset.episode_shards)):
        if not shards and info is not None and info.episodes:
            yield error(pattern, f"no such file, though {layout.INFO} counts {plural(info.episodes, 'episode')}")
        for shard in shards:
            if shard.problem:
                yield error(shard.name, shard.problem)


def check_episodes(dataset: Dataset) -> Iterator[Finding]:
    """`meta/episodes` counts from 0, each episode begins where the one before ends, and info.json agrees."""
    yield from dataset.episode_findings
    info, episodes = dataset.info, dataset.episodes
    if info is None or episodes is None:
        return
    yield from _contiguous(episodes)
    if dataset.episode_findings or any(shard.problem for shard in dataset.episode_shards):
        return  # the rows that cannot be read are named; without them no sum is right
    for what, counted, found in (
        ("episodes", info.episodes, len(episodes)),
        ("frames", info.frames, int(episodes.length.sum())),
    ):
        if counted != found:
            yield error(layout.INFO, f"total_{what} is {counted:,}; {EPISODES} holds {found:,}")


def check_tasks(dataset: Dataset) -> Iterator[Finding]:
    """`meta/tasks.parquet` numbers the tasks, and episodes name no other."""
    info = dataset.info
    if info is None or (info.episodes == 0 and not (dataset.root / layout.TASKS).exists()):
        return
    try:
        numbers, names = read_tasks(dataset)
    except FileNotFoundError:
        yield error(layout.TASKS, "is missing: no row's task has a name")
        return
    except UNREADABLE as problem:
        yield error(layout.TASKS, str(problem))
        return
    if sorted(numbers) != list(range(len(numbers))):
        yield error(layout.TASKS, f"task_index holds {some(numbers)}; expected 0 to {len(numbers) - 1}, each once")
    if info.tasks not in (None, len(numbers)):
        yield error(layout.INFO, f"total_tasks is {info.tasks}; {layout.TASKS} holds {len(numbers)}")
    if dataset.episodes is not None and (unknown := set(chain.from_iterable(dataset.episodes.tasks)) - set(names)):
        yield error(EPISODES, f"names the task {some(map(repr, sorted(unknown)))}, which {layout.TASKS} does not hold")


def read_tasks(dataset: Dataset) -> tuple[list[int], list[str]]:
    """Return numbers and names of the tasks. Raises one of `UNREADABLE`."""
    path = dataset.root / layout.TASKS
    if not path.is_file():
        raise FileNotFoundError(path)
    shard = open_shard(layout.TASKS, path)
    if shard.problem:
        raise BadColumn(shard.problem)
    table = pa.concat_tables(shard.tables())
    names = [one.name for one in table.schema if pa.types.is_string(one.type) or pa.types.is_large_string(one.type)]
    if len(names) != 1:  # pandas names the index `task`, or leaves it without a name of its own
        raise BadColumn(f"has {plural(len(names), 'column')} of text; expected the tasks' names in one")
    return integers(table, layout.TASK_INDEX).tolist(), table.column(names[0]).to_pylist()


def _contiguous(episodes: Episodes) -> Iterator[Finding]:
    expected = np.arange(len(episodes))
    before = np.concatenate([[0], episodes.stop[:-1]])
    for name, found, wanted in (
        (layout.EPISODE_INDEX, episodes.index, expected),
        ("dataset_from_index", episodes.start, before),
        ("dataset_to_index", episodes.stop, episodes.start + episodes.length),
    ):
        bad = np.flatnonzero(found != wanted)
        if len(bad):
            row = bad[0]
            yield error(
                f"{EPISODES}: {name}",
                f"row {row:,} has {found[row]:,}; expected {wanted[row]:,} ({plural(len(bad), 'row')} like this)",
            )
    if len(bad := np.flatnonzero(episodes.length < 1)):
        yield error(f"{EPISODES}: length", f"episode {episodes.index[bad[0]]} has {episodes.length[bad[0]]} frames")


def _check_names(info: Info) -> Iterator[Finding]:
    for feature in info.features.values():
        count = _name_count(feature.names)
        wanted = len(feature.shape) if feature.dtype in PICTURES else feature.size
        fits = count in (None, wanted) or (len(feature.shape) > 1 and count == len(feature.shape))
        if not fits:
            shape = list(feature.shape)
            yield error(f"{layout.INFO}: {feature.key}", f"{count} names for shape {shape}; expected {wanted}")


def _name_count(names: Any) -> int | None:
    """How many names; None where there are none, or in a form that cannot be counted."""
    if isinstance(names, list):
        return len(cast(list[Any], names))
    if isinstance(names, dict) and names:
        values = list(cast(dict[str, Any], names).values())
        lists = [cast(list[Any], value) for value in values if isinstance(value, list)]
        return sum(map(len, lists)) if len(lists) == len(values) else len(values) if not lists else None
    return None
