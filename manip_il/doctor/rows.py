"""Checks of the data files: columns, rows, numbers, and the statistics of numbers in `meta/stats.json`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from manip_il.data import lerobot_layout as layout
from manip_il.data.episode_table import EpisodeTable
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES, Feature
from manip_il.data.parquet_files import UNREADABLE, read_tasks
from manip_il.data.statistics import quantile_places
from manip_il.doctor.finding import Finding, Remedy, error, list_first, plural, warning
from manip_il.doctor.meta import EPISODES
from manip_il.doctor.patient import Patient
from manip_il.doctor.scan import F64, I64, Moments, Runs

_DATA = "data"
# Shares of a column's largest absolute value. LeRobot's standard deviation is a difference of squares in float32,
# which leaves it the root of that precision.
_TOLERANCES = {"min": 1e-5, "max": 1e-5, "mean": 1e-4, "std": 2e-3}


def check_columns(dataset: Patient) -> Iterator[Finding]:
    """Check that every data file has the columns of info.json and no other: LeRobot loads no file that has."""
    if dataset.info is None:
        return
    wanted = {feature.key for feature in dataset.info.features.values() if feature.dtype != "video"}
    for shard in dataset.data_shards:
        if shard.problem:
            continue
        if missing := sorted(wanted - set(shard.columns)):
            yield error(shard.name, f"lacks the column {list_first(missing)} of {layout.INFO}")
        if extra := sorted(set(shard.columns) - wanted):
            yield error(shard.name, f"has the column {list_first(extra)}, which {layout.INFO} does not list")


def check_rows(dataset: Patient) -> Iterator[Finding]:
    """Check that every episode's rows are there, once, in order, in the file that `meta/episodes` names."""
    yield from dataset.scan.findings
    info, episodes = dataset.info, dataset.episodes
    if info is None:
        return
    if dataset.reads_all_rows and dataset.scan.rows != info.frames:
        held = plural(dataset.scan.rows, "row")
        yield error(layout.INFO, f"total_frames is {info.frames:,}; the data files hold {held}")
    if episodes is not None and len(np.unique(episodes.index)) == len(episodes):
        yield from _check_episodes(dataset, episodes)


def check_task_numbers(dataset: Patient) -> Iterator[Finding]:
    """Check that `task_index` of every row is in `meta/tasks.parquet`."""
    try:
        numbers, _ = read_tasks(dataset.root)
    except UNREADABLE:
        return  # reported by the check of tasks
    if unknown := sorted(dataset.scan.tasks - set(numbers)):
        place = f"{_DATA}: {layout.TASK_INDEX}"
        yield error(place, f"rows have {list_first(unknown)}, which {layout.TASKS} does not hold")


def check_finite(dataset: Patient) -> Iterator[Finding]:
    """Check that no column has NaN or infinity."""
    for key, moments in dataset.scan.moments.items():
        if moments.first_bad is not None:
            row, value = moments.first_bad
            like = plural(moments.bad_rows, "row")
            yield error(f"{_DATA}: {key}", f"{value} in row {row:,} of the dataset ({like} like this)")


def check_statistics(dataset: Patient) -> Iterator[Finding]:
    """Check that `meta/stats.json` has the statistics of every column, and that those of numbers are the data's."""
    info, stats = dataset.info, dataset.stats
    if info is None or info.episodes == 0:
        return
    if stats is None:
        if (dataset.root / layout.STATS).exists():
            yield error(layout.STATS, "cannot be read: nothing can be normalised with it", Remedy.STATISTICS)
        else:
            yield warning(layout.STATS, "is missing: LeRobot normalises nothing without it", Remedy.STATISTICS)
        return
    if unknown := sorted(set(stats) - set(info.features)):
        yield warning(layout.STATS, f"has statistics of {list_first(unknown)}, which {layout.INFO} does not list")
    yield from _check_all_moments(dataset, info.of_dtype(*NUMBERS))
    for feature in info.of_dtype(*PICTURES):
        if not isinstance(stats.get(feature.key), dict):
            yield error(f"{layout.STATS}: {feature.key}", "is missing")
    yield from _check_ranks(dataset)


def _check_episodes(dataset: Patient, episodes: EpisodeTable) -> Iterator[Finding]:
    runs = dataset.scan.runs
    numbers, first, counts = np.unique(runs.episode, return_index=True, return_counts=True)
    if (counts > 1).any():
        twice = numbers[counts > 1]
        files = list_first(dict.fromkeys(runs.files[row] for row in np.flatnonzero(runs.episode == twice[0])))
        yield error(_DATA, f"rows of {_list_episodes(twice)} are in several places ({files})")
    if len(unknown := np.setdiff1d(numbers, episodes.index)) and dataset.knows_all_episodes:
        file = runs.files[first[np.searchsorted(numbers, unknown[0])]]
        yield error(file, f"holds rows of {_list_episodes(unknown)}, which {EPISODES} does not list")
    unread = {shard.name for shard in dataset.data_shards} - dataset.scan.readable  # reported already
    named = np.array([file not in unread for file in episodes.files], dtype=bool)
    if len(missing := np.setdiff1d(episodes.index[named], numbers)):
        yield error(EPISODES, f"names {_list_episodes(missing)}, whose rows are in no readable data file")
    once = first[counts == 1]
    _, mine, theirs = np.intersect1d(runs.episode[once], episodes.index, return_indices=True)
    yield from _compare_places(runs, once[mine], episodes, theirs)


def _compare_places(runs: Runs, run: I64, episodes: EpisodeTable, row: I64) -> Iterator[Finding]:
    for name, found, wanted in (
        ("length", runs.length[run], episodes.length[row]),
        ("dataset_from_index", runs.start[run], episodes.start[row]),
    ):
        if len(bad := np.flatnonzero(found != wanted)):
            first, like = bad[0], plural(len(bad), "episode")
            what = f"rows give {found[first]:,} for episode {episodes.index[row[first]]}"
            yield error(f"{EPISODES}: {name}", f"{wanted[first]:,}, but its {what} ({like} like this)")
    places = [(runs.files[i], episodes.files[j], episodes.index[j]) for i, j in zip(run, row, strict=True)]
    if bad_places := [place for place in places if place[0] != place[1]]:
        found, wanted, number = bad_places[0]
        text = f"names {wanted} for episode {number}; its rows are in {found}"
        yield error(f"{EPISODES}: data/file_index", f"{text} ({plural(len(bad_places), 'episode')} like this)")


def _list_episodes(numbers: I64) -> str:
    return f"episode{'' if len(numbers) == 1 else 's'} {list_first(numbers.tolist())}"


def _check_all_moments(dataset: Patient, features: list[Feature]) -> Iterator[Finding]:
    stale: list[str] = []
    for feature in features if dataset.reads_all_rows else []:
        moments = dataset.scan.moments.get(feature.key)
        if moments is None or moments.bad_rows or not moments.rows:
            continue
        findings = list(_check_moments(dataset, feature, moments))
        if findings and feature.key in INDEX_FEATURES:
            stale.append(feature.key)
        else:
            yield from findings
    if stale:
        what = f"statistics of {list_first(stale)} are not the data's"
        text = f"{what}; LeRobot's tools do not update them, and nothing needs them"
        yield warning(layout.STATS, text, Remedy.STATISTICS)


def _check_moments(dataset: Patient, feature: Feature, moments: Moments) -> Iterator[Finding]:
    place = f"{layout.STATS}: {feature.key}"
    table: Any = (dataset.stats or {}).get(feature.key)
    if not isinstance(table, dict):
        yield error(place, "is missing", Remedy.STATISTICS)
        return
    count = dataset.statistic(feature.key, "count")
    if count is None or count.tolist() != [moments.rows]:
        found = "nothing" if count is None else ", ".join(f"{value:g}" for value in count)
        yield error(place, f"count is {found}; the data has {plural(moments.rows, 'frame')}", Remedy.STATISTICS)
    mean = dataset.statistic(feature.key, "mean")
    if len(feature.shape) > 1 and mean is not None and mean.size == feature.shape[-1] != feature.size:
        moments = moments.over_last_axis(feature.shape)
    scale = np.maximum(np.abs(moments.low), np.abs(moments.high))
    wanted = {"min": moments.low, "max": moments.high, "mean": moments.mean, "std": moments.std}
    for name, values in wanted.items():
        text = _differ(dataset.statistic(feature.key, name), values, _TOLERANCES[name] * scale + 1e-9)
        if text:
            yield error(place, f"{name}{text}", Remedy.STATISTICS)
    # LeRobot's quantiles of a dataset are means over its episodes', so that only their order is sure
    rows = [dataset.statistic(feature.key, name) for name in layout.QUANTILES]
    present = [row for row in rows if row is not None and len(row) == len(scale)]
    names = ", ".join(layout.QUANTILES)
    if present and (np.diff([moments.low, *present, moments.high], axis=0) < -1e-5 * scale - 1e-9).any():
        yield error(place, f"{names} are not in order between min and max", Remedy.STATISTICS)
    elif len(present) < len(rows) and any(name in table for name in layout.QUANTILES):
        yield error(place, f"{names} are not all there", Remedy.STATISTICS)


def _differ(found: F64 | None, wanted: F64, tolerance: F64) -> str:
    """Return how a statistic differs from the data's, as the end of a sentence; empty where it does not."""
    if found is None or len(found) != len(wanted):
        what = "no numbers" if found is None else plural(len(found), "number")
        return f" is {what}; expected {plural(len(wanted), 'number')}"
    bad = np.flatnonzero(~(np.abs(found - wanted) <= tolerance))
    if not len(bad):
        return ""
    text = f" is {found[bad[0]]:.6g}; the data's is {wanted[bad[0]]:.6g}"
    return f"[{bad[0]}]{text} ({len(bad)} of {len(wanted)} numbers like this)" if len(wanted) > 1 else text


def _check_ranks(dataset: Patient) -> Iterator[Finding]:
    """Check quantiles of this program: q of T numbers is the one of rank ceil(q T), from 1."""
    wrong: list[str] = []
    for key, moments in dataset.scan.moments.items():
        if not len(moments.quantiles) or moments.bad_rows:
            continue
        ranks = np.array([[place + 1] for place in quantile_places(moments.rows).values()])
        if ((moments.below >= ranks) | (moments.up_to < ranks)).any():
            wrong.append(key)
    if wrong:
        text = f"quantiles of {list_first(wrong)} are not those of all frames (LeRobot averages them over episodes)"
        yield warning(layout.STATS, text, Remedy.STATISTICS)
