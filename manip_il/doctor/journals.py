"""Checks of the journals that stand beside a dataset: each can be read, and the dataset holds their episodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from manip_il.data.atomic import PARTIAL
from manip_il.data.build import RECORDING, Recording
from manip_il.data.episodes import Header
from manip_il.data.journal import list_episodes, read_header
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, Remedy, error, plural, some, warning
from manip_il.errors import ManipError


def check_journals(dataset: Dataset) -> Iterator[Finding]:
    """Yield every journal is whole, and the dataset holds the episodes that they make."""
    folder = dataset.journals
    if not folder.is_dir():
        return
    headers: list[Header] = []
    for path in list_episodes(folder):
        header = _read(path)
        if isinstance(header, Header):
            headers.append(header)
        else:
            yield error(f"{folder.name}/{path.name}", header, Remedy.NONE)
        dataset.on_file()
    for path in sorted([*folder.glob(f".episode-*{PARTIAL}"), *folder.glob("*.damaged")]):
        yield warning(f"{folder.name}/{path.name}", "left by a killed writer or a damaged episode; nothing reads it")
    try:
        recording = Recording.read(folder)
    except ManipError as problem:
        yield error(f"{folder.name}/{RECORDING}", str(problem), Remedy.NONE)
        return
    yield from _compare(dataset, expected_seeds(headers, recording))


def expected_seeds(headers: list[Header], recording: Recording) -> list[int]:
    """Return the seeds of the episodes that a dataset of these journals holds, in order."""
    taken = [one.seed for one in headers if one.success or not recording.only_successes]
    return taken if recording.episodes is None else taken[: recording.episodes]


def readable_episodes(folder: Path) -> int:
    """Return how many episodes a dataset of these journals would hold."""
    headers = [header for path in list_episodes(folder) if isinstance(header := _read(path), Header)]
    return len(expected_seeds(headers, Recording.read(folder)))


def _compare(dataset: Dataset, expected: list[int]) -> Iterator[Finding]:
    if not dataset.reads_all_rows:
        return
    runs, place = dataset.scan.runs, dataset.journals.name
    if len(runs.seeds) != len(runs):
        if len(expected) != len(runs):
            text = f"the journals make {plural(len(expected), 'episode')}; the dataset has {len(runs):,}"
            yield warning(place, text, Remedy.REBUILD if len(expected) > len(runs) else Remedy.NONE)
        return
    seeds = set(runs.seeds.tolist())
    if absent := [seed for seed in expected if seed not in seeds]:
        text = f"the dataset lacks {plural(len(absent), 'episode')} of the journals (seed {some(absent)})"
        yield warning(place, f"{text}; build it again from them", Remedy.REBUILD)
    if alone := sorted(seeds - set(expected)):
        text = f"no intact journal for {plural(len(alone), 'episode')} of the dataset (seed {some(alone)})"
        yield warning(place, f"{text}: only the dataset holds them")


def _read(path: Path) -> Header | str:
    """The header of a whole journal, or what is wrong with it."""
    try:
        return read_header(path, check_sums=True)  # checksums: forty times faster than to take all records apart
    except (ManipError, OSError) as problem:
        return str(problem).removeprefix(f"{path} ")
