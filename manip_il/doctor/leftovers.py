"""Checks of what is beside the data: leftovers of killed recorders, writers and downloads, unused files, journals."""

from __future__ import annotations

import contextlib
import fcntl
import re
from collections.abc import Iterator
from pathlib import Path

from manip_il.data.atomic import PARTIAL, descriptor, try_lock
from manip_il.data.build import RECORDING, Recording
from manip_il.data.journal import Header, list_episodes, read_header
from manip_il.data.parquet_files import NO_FOOTER
from manip_il.doctor.finding import Finding, Remedy, count_frames, error, list_first, plural, warning
from manip_il.doctor.patient import Patient
from manip_il.errors import ManipError

BESIDE = "../"  # first part of the place of a file beside the dataset
_IMAGES = "images"  # where LeRobot's recorder keeps frames until they are encoded
_FOLDERS = ("data", "videos", "meta/episodes")
_TEMPORARY = re.compile(r".*\.(partial|incomplete|ffconcat)|\..*\.tmp")
_TEMPORARY_FOLDER = re.compile(r"tmp[a-z0-9_]{8}")  # of Python's tempfile, which LeRobot encodes videos in


def check_recorder(dataset: Patient) -> Iterator[Finding]:
    """Check that LeRobot's own recorder did not die before `finalize()`: it closes its files only there."""
    info = dataset.info
    if info is None or dataset.is_ours:
        return
    pictures = sorted({path.name for path in dataset.root.glob(f"{_IMAGES}/*/episode-*") if any(path.iterdir())})
    unsaved = f"; pictures of {list_first(pictures)} that it had not encoded are in {_IMAGES}" if pictures else ""
    open_files = [one.name for one in (*dataset.data_shards, *dataset.episode_shards) if one.problem == NO_FOOTER]
    readable = {shard.name for shard in dataset.data_shards if not shard.problem}
    whole = sum(file in readable for file in dataset.episodes.files) if dataset.episodes else 0
    if info.episodes == 0 and not dataset.data_shards and not dataset.episode_shards:
        text = f"a recorder was started here, but no episode was saved{unsaved}; record again"
        yield error(str(dataset.root), text)
    elif whole < info.episodes and any(one.problem == NO_FOOTER for one in dataset.data_shards):
        films = len(list(dataset.root.glob("videos/*/*/*.mp4")))
        remain = f"; {plural(films, 'video file')} remain, without the rows they belong to" if films else ""
        yield error(
            str(dataset.root),
            f"LeRobot's recorder died here before finalize(): it had saved {count_frames(info.episodes, info.frames)}, "
            f"but the rows of {plural(info.episodes - whole, 'episode')} are lost, as it never closed "
            f"{list_first(open_files)}{remain}{unsaved}; {_advise(dataset, whole)}",
        )


def check_stale_files(dataset: Patient) -> Iterator[Finding]:
    """Check that an episode refers to every file among data, videos and episodes."""
    episodes = dataset.episodes
    if episodes is None or not dataset.knows_all_episodes:
        return  # an episode that cannot be read may refer to them
    known = {*episodes.files, *(file for clips in episodes.clips.values() for file in clips.files)}
    known |= {shard.name for shard in dataset.episode_shards}
    read = {shard.name for shard in dataset.data_shards}
    for path in _files(dataset.root, *_FOLDERS):
        name = path.relative_to(dataset.root).as_posix()
        if name in read - known:
            yield error(name, "no episode refers to it, but LeRobot reads it with the others", Remedy.MOVE)
        elif name not in known:
            yield warning(name, "no episode refers to it", Remedy.MOVE)


def check_leftovers(dataset: Patient) -> Iterator[Finding]:
    """Check that there are no temporary files or folders, in the dataset or beside it."""
    root = dataset.root
    if pictures := len(_files(root, _IMAGES)):
        text = f"{plural(pictures, 'picture')} that LeRobot's recorder had not encoded or not removed when it died"
        yield warning(_IMAGES, text, Remedy.MOVE)
    if (root / ".cache").is_dir():
        yield warning(".cache", "left by a download from the Hub; nothing needs it", Remedy.MOVE)
    for path in sorted(root.iterdir()):
        if _TEMPORARY_FOLDER.fullmatch(path.name) and path.is_dir():
            text = f"a temporary folder of {plural(len(_files(path, '.')), 'file')} left by a killed video encoder"
            yield warning(path.name, text, Remedy.MOVE)
    for path in [*sorted(path for path in root.iterdir() if path.is_file()), *_files(root, "meta")]:
        name = path.relative_to(root).as_posix()
        if _TEMPORARY.fullmatch(path.name) and not name.startswith(_FOLDERS):
            yield warning(name, "a temporary file left by a killed writer", Remedy.MOVE)
    yield from _check_beside(root.absolute())


def check_journals(dataset: Patient) -> Iterator[Finding]:
    """Check that every journal beside the dataset is whole, and that the dataset holds their episodes."""
    folder = dataset.journals
    if not folder.is_dir():
        return
    headers: list[Header] = []
    for path in list_episodes(folder):
        header = _read_header(path)
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
    yield from _compare_seeds(dataset, _expected_seeds(headers, recording))


def count_readable(folder: Path) -> int:
    """Return how many episodes a dataset of these journals would hold. Raises `ManipError`."""
    headers = [header for path in list_episodes(folder) if isinstance(header := _read_header(path), Header)]
    return len(_expected_seeds(headers, Recording.read(folder)))


def _advise(dataset: Patient, whole: int) -> str:
    if not whole or dataset.episodes is None:
        return "LeRobot can neither read nor resume this: record again, into another folder"
    frames = int(dataset.episodes.length[:whole].sum())
    return (
        f"the first {count_frames(whole, frames)} are intact: LeRobot reads them again once those files are moved "
        f'away and meta/info.json has these counts, with "train": "0:{whole}" in its splits; then --repair=true '
        f"computes their statistics"
    )


def _check_beside(root: Path) -> Iterator[Finding]:
    lock = root.with_name(f".{root.name}.lock")
    if lock.is_file() and _is_held(lock):
        holder = lock.read_text(errors="replace").strip() or "unknown"
        text = f"process {holder} is writing to this dataset; these findings may change"
        yield warning(f"{BESIDE}{lock.name}", text)
    for path in sorted(root.parent.iterdir()):
        is_partial = path.name.startswith(f".{root.name}.") and path.name.endswith(PARTIAL)
        is_deleted = path.name.startswith(f".{root.name}.deleting.")
        if (is_partial or is_deleted) and not _is_held(path):
            yield warning(f"{BESIDE}{path.name}", "left by a killed writer of this dataset", Remedy.MOVE)


def _is_held(path: Path) -> bool:
    """Return whether a living process has locked the file or folder."""
    with contextlib.suppress(OSError), descriptor(path) as handle:
        return not try_lock(handle, fcntl.LOCK_SH)
    return False


def _files(root: Path, *folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (root / folder).rglob("*") if path.is_file())


def _expected_seeds(headers: list[Header], recording: Recording) -> list[int]:
    """Return the seeds of the episodes that a dataset of these journals holds, in order."""
    taken = [one.seed for one in headers if one.success or not recording.only_successes]
    return taken if recording.episodes is None else taken[: recording.episodes]


def _compare_seeds(dataset: Patient, expected: list[int]) -> Iterator[Finding]:
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
        text = f"the dataset lacks {plural(len(absent), 'episode')} of the journals (seed {list_first(absent)})"
        yield warning(place, f"{text}; build it again from them", Remedy.REBUILD)
    if alone := sorted(seeds - set(expected)):
        text = f"no intact journal for {plural(len(alone), 'episode')} of the dataset (seed {list_first(alone)})"
        yield warning(place, f"{text}: only the dataset holds them")


def _read_header(path: Path) -> Header | str:
    """Return the header of a whole journal, or what is wrong with it."""
    try:
        return read_header(path)
    except (ManipError, OSError) as problem:
        return str(problem).removeprefix(f"{path} ")
