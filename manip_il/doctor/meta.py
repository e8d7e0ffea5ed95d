"""Checks of the files in `meta/`, statistics apart: info.json, tasks, episodes, and this program's own file."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any, cast

import numpy as np

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import find_irregular
from manip_il.data.episode_table import EpisodeTable
from manip_il.data.fingerprint import compare_fingerprints, environment_fingerprint
from manip_il.data.info import INDEX_FEATURES, PICTURES, Feature
from manip_il.data.parquet_files import UNREADABLE, read_tasks
from manip_il.doctor.finding import Finding, error, list_first, plural, warning
from manip_il.doctor.patient import Patient
from manip_il.errors import ManipError

EPISODES = "meta/episodes"
_HASH = "_sha256"


def check_info(dataset: Patient) -> Iterator[Finding]:
    """Check that `meta/info.json` can be used, has the columns of every dataset, and as many names as numbers."""
    for text in dataset.info_problems:
        yield error(layout.INFO, text)
    if dataset.info is None:
        return
    features = dataset.info.features
    if missing := [key for key in INDEX_FEATURES if key not in features]:
        yield error(layout.INFO, f"features lack {', '.join(missing)}, which every LeRobot dataset has")
    for key, feature in features.items():
        count, axes = _count_names(feature.names), len(feature.shape)
        wanted = axes if feature.dtype in PICTURES else feature.size
        if count not in (None, wanted) and not (axes > 1 and count == axes):
            yield error(f"{layout.INFO}: {key}", f"{count} names for shape {list(feature.shape)}; expected {wanted}")


def check_regular(dataset: Patient) -> Iterator[Finding]:
    """Check that the folder holds files and folders alone: a reader of a pipe waits, a device has no end."""
    for path in find_irregular(dataset.root):
        place = path.relative_to(dataset.root).as_posix()
        yield error(place, "is not a regular file, but a pipe, device, socket or broken link")


def check_footers(dataset: Patient) -> Iterator[Finding]:
    """Check that parquet files of data and of episodes are there and have readable footers."""
    info = dataset.info
    for pattern, shards in ((layout.DATA_FILES, dataset.data_shards), (layout.EPISODES_FILES, dataset.episode_shards)):
        if not shards and info is not None and info.episodes:
            yield error(pattern, f"no such file, though {layout.INFO} counts {plural(info.episodes, 'episode')}")
        for shard in shards:
            if shard.problem:
                yield error(shard.name, shard.problem)


def check_episodes(dataset: Patient) -> Iterator[Finding]:
    """Check that episodes count from 0, that each begins where the one before ends, and info.json's totals."""
    yield from dataset.episode_findings
    info, episodes = dataset.info, dataset.episodes
    if info is None or episodes is None:
        return
    yield from _check_sequence(episodes)
    if not dataset.reads_all_episodes:
        return  # the rows that cannot be read are reported; without them no sum is right
    for what, counted, found in (
        ("episodes", info.episodes, len(episodes)),
        ("frames", info.frames, int(episodes.length.sum())),
    ):
        if counted != found:
            yield error(layout.INFO, f"total_{what} is {counted:,}; {EPISODES} holds {found:,}")


def check_tasks(dataset: Patient) -> Iterator[Finding]:
    """Check that `meta/tasks.parquet` numbers the tasks, and that episodes name no other."""
    info = dataset.info
    if info is None or (info.episodes == 0 and not (dataset.root / layout.TASKS).exists()):
        return
    try:
        numbers, names = read_tasks(dataset.root)
    except FileNotFoundError:
        yield error(layout.TASKS, "is missing: no row's task has a name")
        return
    except UNREADABLE as problem:
        yield error(layout.TASKS, str(problem))
        return
    if sorted(numbers) != list(range(len(numbers))):
        found = list_first(numbers)
        yield error(layout.TASKS, f"task_index holds {found}; expected 0 to {len(numbers) - 1}, each once")
    if info.tasks not in (None, len(numbers)):
        yield error(layout.INFO, f"total_tasks is {info.tasks}; {layout.TASKS} holds {len(numbers)}")
    if dataset.episodes is not None and (unknown := set(chain.from_iterable(dataset.episodes.tasks)) - set(names)):
        found = list_first(map(repr, sorted(unknown)))
        yield error(EPISODES, f"names the task {found}, which {layout.TASKS} does not hold")


def check_spec(dataset: Patient) -> Iterator[Finding]:
    """Check that columns, names and rate are those of the robot and task in this program's own file."""
    info = dataset.info
    if info is None:
        return
    try:
        own = dataset.own
    except ManipError as problem:
        yield error(layout.OURS, f"cannot be read: {problem}")
        return
    if own is None:
        if {s.SIM_STATE, s.EXECUTED_ACTION} <= info.features.keys():
            yield warning(layout.OURS, "is missing (LeRobot's tools drop it): the task and the fingerprint are unknown")
        return
    spec = own.spec
    for what, said, found in (("fps", spec.fps, info.fps), ("robot_type", spec.lerobot_type, info.robot)):
        if said != found:
            yield error(layout.INFO, f"{what} is {found!r}; {layout.OURS} says {said!r}")
    wanted = layout.all_features(spec)
    for key, feature in wanted.items():
        yield from _check_feature(key, feature, info.features.get(key))
    if extra := sorted(info.features.keys() - wanted.keys()):
        yield warning(layout.INFO, f"has {list_first(extra)} beside the columns of {spec.robot} {spec.task}")


def check_fingerprint(dataset: Patient) -> Iterator[Finding]:
    """Check that the dataset was recorded with the versions that are installed here."""
    try:
        own = dataset.own
    except ManipError:
        return  # reported by the check of the spec
    if own is None:
        return
    if not own.fingerprint:
        yield warning(layout.OURS, "has no fingerprint: what the dataset was recorded with is not known")
        return
    theirs, here = (
        {str(key): value for key, value in table.items() if not str(key).endswith(_HASH) and key != "processor"}
        for table in (own.fingerprint, environment_fingerprint(b"", {}))
    )  # versions alone: another processor is no fault of a dataset
    for text in compare_fingerprints("the dataset", theirs, "this installation", here):
        yield warning(layout.OURS, text)


def _count_names(names: Any) -> int | None:
    """Return how many names there are; None for none, and for a form that cannot be counted."""
    if isinstance(names, list):
        return len(cast(list[Any], names))
    if isinstance(names, dict) and names:
        values = list(cast(dict[str, Any], names).values())
        lists = [cast(list[Any], value) for value in values if isinstance(value, list)]
        return sum(map(len, lists)) if len(lists) == len(values) else len(values) if not lists else None
    return None


def _check_sequence(episodes: EpisodeTable) -> Iterator[Finding]:
    ends_before = np.concatenate([[0], episodes.stop[:-1]])
    for name, found, wanted in (
        (layout.EPISODE_INDEX, episodes.index, np.arange(len(episodes))),
        ("dataset_from_index", episodes.start, ends_before),
        ("dataset_to_index", episodes.stop, episodes.start + episodes.length),
    ):
        if len(bad := np.flatnonzero(found != wanted)):
            row, like = bad[0], plural(len(bad), "row")
            text = f"row {row:,} has {found[row]:,}; expected {wanted[row]:,} ({like} like this)"
            yield error(f"{EPISODES}: {name}", text)
    if len(bad := np.flatnonzero(episodes.length < 1)):
        yield error(f"{EPISODES}: length", f"episode {episodes.index[bad[0]]} has {episodes.length[bad[0]]} frames")


def _check_feature(key: str, wanted: dict[str, Any], found: Feature | None) -> Iterator[Finding]:
    if found is None:
        yield error(layout.INFO, f"features lack {key!r}, which every dataset of this program has")
        return
    for what, mine in (("dtype", wanted["dtype"]), ("shape", tuple(wanted["shape"])), ("names", wanted["names"])):
        theirs = getattr(found, what)
        if what == "dtype" and key.startswith(s.IMAGES) and theirs == "image":
            continue  # a camera may be stored as video or as pictures
        if theirs != mine:
            yield error(f"{layout.INFO}: {key}", f"{what} {_shorten(theirs)}; {layout.OURS} makes it {_shorten(mine)}")


def _shorten(value: object) -> str:
    text = str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
