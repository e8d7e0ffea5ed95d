"""Checks of rows: every episode's rows are there, once, in order, in the file that `meta/episodes` names."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from manip_il.data import lerobot_layout as layout
from manip_il.data.shards import UNREADABLE
from manip_il.doctor.dataset import I64, Dataset, Episodes
from manip_il.doctor.finding import Finding, error, plural, some
from manip_il.doctor.meta import EPISODES, read_tasks
from manip_il.doctor.scan import Runs, episodes_text

_DATA = "data"


def check_columns(dataset: Dataset) -> Iterator[Finding]:
    """Yield every data file has the columns of info.json, and no other: LeRobot loads none that has."""
    if dataset.info is None:
        return
    wanted = {feature.key for feature in dataset.info.features.values() if feature.dtype != "video"}
    for shard in dataset.data_shards:
        if shard.problem:
            continue
        if missing := sorted(wanted - set(shard.columns)):
            yield error(shard.name, f"lacks the column {some(missing)} of {layout.INFO}")
        if extra := sorted(set(shard.columns) - wanted):
            yield error(shard.name, f"has the column {some(extra)}, which {layout.INFO} does not list")


def check_rows(dataset: Dataset) -> Iterator[Finding]:
    """Yield rows count as info.json, `meta/episodes` and their own index columns say."""
    yield from dataset.scan.findings
    info, episodes = dataset.info, dataset.episodes
    if info is None:
        return
    if dataset.reads_all_rows and dataset.scan.rows != info.frames:
        held = plural(dataset.scan.rows, "row")
        yield error(layout.INFO, f"total_frames is {info.frames:,}; the data files hold {held}")
    if episodes is not None and len(np.unique(episodes.index)) == len(episodes):
        yield from _against_episodes(dataset, episodes)


def check_task_numbers(dataset: Dataset) -> Iterator[Finding]:
    """`task_index` of every row is in `meta/tasks.parquet`."""
    try:
        numbers, _ = read_tasks(dataset)
    except UNREADABLE:
        return  # named by the check of tasks
    if unknown := sorted(dataset.scan.tasks - set(numbers)):
        yield error(f"{_DATA}: {layout.TASK_INDEX}", f"rows have {some(unknown)}, which {layout.TASKS} does not hold")


def _against_episodes(dataset: Dataset, episodes: Episodes) -> Iterator[Finding]:
    runs = dataset.scan.runs
    numbers, first, counts = np.unique(runs.episode, return_index=True, return_counts=True)
    if (counts > 1).any():
        twice = numbers[counts > 1]
        files = dict.fromkeys(runs.files[row] for row in np.flatnonzero(runs.episode == twice[0]))
        yield error(_DATA, f"rows of {episodes_text(twice)} are in several places ({some(files)})")
    if len(unknown := np.setdiff1d(numbers, episodes.index)) and dataset.knows_all_episodes:
        file = runs.files[first[np.searchsorted(numbers, unknown[0])]]
        yield error(file, f"holds rows of {episodes_text(unknown)}, which {EPISODES} does not list")
    unread = {shard.name for shard in dataset.data_shards} - dataset.scan.readable  # named already
    named = np.array([file not in unread for file in episodes.files], dtype=bool)
    if len(missing := np.setdiff1d(episodes.index[named], numbers)):
        yield error(EPISODES, f"names {episodes_text(missing)}, whose rows are in no readable data file")
    once = first[counts == 1]
    _, mine, theirs = np.intersect1d(runs.episode[once], episodes.index, return_indices=True)
    yield from _compare(runs, once[mine], episodes, theirs)


def _compare(runs: Runs, run: I64, episodes: Episodes, row: I64) -> Iterator[Finding]:
    for name, found, wanted in (
        ("length", runs.length[run], episodes.length[row]),
        ("dataset_from_index", runs.start[run], episodes.start[row]),
    ):
        bad = np.flatnonzero(found != wanted)
        if len(bad):
            first = bad[0]
            what = f"rows give {found[first]:,} for episode {episodes.index[row[first]]}"
            like = plural(len(bad), "episode")
            yield error(f"{EPISODES}: {name}", f"{wanted[first]:,}, but its {what} ({like} like this)")
    places = [(runs.files[i], episodes.files[j], episodes.index[j]) for i, j in zip(run, row, strict=True)]
    if bad_places := [place for place in places if place[0] != place[1]]:
        found, wanted, number = bad_places[0]
        text = f"names {wanted} for episode {number}; its rows are in {found}"
        yield error(f"{EPISODES}: data/file_index", f"{text} ({plural(len(bad_places), 'episode')} like this)")
