"""Checks for what does not belong: files that nothing refers to, and what killed writers and downloads left."""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Iterator
from pathlib import Path

from manip_il.data.atomic import PARTIAL
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, Remedy, error, plural, warning

IMAGES = "images"  # where LeRobot's recorder keeps frames until they are encoded
BESIDE = "../"  # how the place of something beside the dataset begins
_FOLDERS = ("data", "videos", "meta/episodes")
_TEMPORARY = re.compile(r".*\.(partial|incomplete|ffconcat)|\..*\.tmp")
_TEMPORARY_FOLDER = re.compile(r"tmp[a-z0-9_]{8}")  # of Python's tempfile, which LeRobot encodes videos in


def check_stale_files(dataset: Dataset) -> Iterator[Finding]:
    """Nothing lies among data, videos and episodes that no episode refers to."""
    episodes = dataset.episodes
    if episodes is None or not dataset.knows_all_episodes:
        return  # what is not known to be referred to may be what is missing
    known = {*episodes.files, *(file for clips in episodes.clips.values() for file in clips.files)}
    known |= {shard.name for shard in dataset.episode_shards}
    read = {shard.name for shard in dataset.data_shards}
    for path in _files(dataset.root, *_FOLDERS):
        name = path.relative_to(dataset.root).as_posix()
        if name in read - known:
            yield error(name, "no episode refers to it, but LeRobot reads it with the others", Remedy.MOVE)
        elif name not in known:
            yield warning(name, "no episode refers to it", Remedy.MOVE)


def check_leftovers(dataset: Dataset) -> Iterator[Finding]:
    """Yield no temporary files or folders, in the dataset or beside it."""
    root = dataset.root
    if pictures := len(_files(root, IMAGES)):
        text = f"{plural(pictures, 'picture')} that LeRobot's recorder had not encoded or not removed when it died"
        yield warning(IMAGES, text, Remedy.MOVE)
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
    yield from _beside(root.absolute())


def _beside(root: Path) -> Iterator[Finding]:
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
    """Whether a living process has locked the file or folder."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False  # a network file system may know no locks
    finally:
        os.close(handle)
    return False


def _files(root: Path, *folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (root / folder).rglob("*") if path.is_file())
