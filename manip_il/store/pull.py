"""A remote to a folder: fetched beside it, verified, and then renamed in one step.

What has arrived stays in the hidden folder `.<name>.pulling` between tries, so that the next one continues there.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

from manip_il.data import atomic
from manip_il.data.gate import check_arrived
from manip_il.errors import FolderExistsError, UsageError
from manip_il.store.disk import HASHERS, Download, is_whole, sync_disk
from manip_il.store.errors import NoSpaceError, NotFoundError, Retry
from manip_il.store.manifest import (
    CHECKPOINTS,
    JOURNALS,
    LAST,
    FileEntry,
    Manifest,
    journals_of,
    newest,
    without_root_copies,
)
from manip_il.store.object_store import in_threads
from manip_il.store.push import datasets_in
from manip_il.store.remote import Progress, Remote, RemoteUrl, Snapshot

RESTARTS = 3  # a remote that is pushed to more often while one pull runs is given up


@dataclass(frozen=True)
class Pulled:
    """Result of a pull. kept: bytes that an earlier try had fetched."""

    manifest: Manifest
    kept: int = 0


def pull(
    url: RemoteUrl,
    remote: Remote,
    target: Path,
    progress: Progress,
    *,
    overwrite: bool = False,
    dry_run: bool = False,
    retry: Retry | None = None,
) -> Pulled:
    """Fetch what readers of the remote see now into `target`, whole, or leave `target` as it is.

    overwrite: replace what is there, in one step. Raises `FolderExistsError` if something is there and may not be
    replaced, `NotFoundError` if the remote holds nothing, `ManipError` for a dataset whose pictures are not in its
    files, and the errors of `manip_il.store.errors`.
    """
    target = target.absolute()
    snapshot = _read(url, remote)
    _check_target(target, snapshot.manifest, overwrite)
    staging = target.with_name(f".{target.name}.pulling")
    if dry_run:
        return Pulled(snapshot.manifest)
    with atomic.exclusive(staging):
        for _ in range(RESTARTS):
            try:
                kept = _fill(staging, remote, snapshot, retry or Retry(), progress)
                break
            except NotFoundError:
                now = _read(url, remote)
                if now.token == snapshot.token:
                    raise
                snapshot = now  # pushed to twice meanwhile: files that are the same stay
        else:
            raise NotFoundError(f"{url} keeps being changed by pushes; pull again when they are done")
        for dataset in datasets_in(staging / "tree"):
            check_arrived(dataset)
        _move_to(staging / "tree", target, snapshot.manifest, overwrite)
        shutil.rmtree(staging, ignore_errors=True)
    return Pulled(snapshot.manifest, kept)


def _fill(staging: Path, remote: Remote, snapshot: Snapshot, retry: Retry, progress: Progress) -> int:
    """Fetch and verify every file; return the number of bytes that were there already.

    In `staging`, `parts` holds unfinished files, by hash, and `tree` verified ones, as they will be.
    """
    manifest, tree, parts = snapshot.manifest, staging / "tree", staging / "parts"
    for folder in (staging, tree, parts):
        if folder.is_symlink():
            folder.unlink()
        folder.mkdir(parents=True, exist_ok=True)
    missing = _missing(tree, manifest)
    for path in parts.iterdir():
        if path.name not in missing or path.is_symlink() or not path.is_file():
            path.unlink()
    wanted = sum(entries[0].size * len(entries) for entries in missing.values())
    had = sum(path.stat().st_size for path in parts.iterdir())
    _check_space(staging, wanted - had)
    whole = manifest.size - wanted

    def fetch(key: str) -> None:
        """Fetch one file's bytes to all places that have them."""
        (first, *others), part = missing[key], parts / key
        download = Download(first, part, advance)
        retry(lambda: download.attempt(lambda to, offset: remote.fetch(snapshot, first, to, offset)))
        for entry in missing[key]:
            (tree / entry.path).parent.mkdir(parents=True, exist_ok=True)
        for entry in others:
            shutil.copyfile(part, tree / entry.path)
            advance(entry.size)
        part.replace(tree / first.path)

    with progress(manifest.size, "pull") as advance:
        advance(whole)
        # The largest first, else the last one runs alone.
        in_threads(remote.threads, fetch, sorted(missing, key=lambda key: -missing[key][0].size))
    sync_disk(staging)
    return whole + had


def _missing(tree: Path, manifest: Manifest) -> dict[str, list[FileEntry]]:
    """Return the entries, by hash, that the tree lacks; remove what else it holds."""
    by_path = manifest.by_path
    there = {path.relative_to(tree).as_posix(): path for path in _leaves(tree)}
    known = [path for path in there if path in by_path]
    whole = in_threads(HASHERS, lambda path: is_whole(by_path[path], there[path]), known)
    for path, place in there.items():
        if not whole.get(path):
            place.unlink()
    for folder in sorted((path for path in tree.rglob("*") if path.is_dir()), reverse=True):
        if not any(folder.iterdir()):  # else a file of the new version may want the name
            folder.rmdir()
    missing: dict[str, list[FileEntry]] = defaultdict(list)
    for entry in manifest.files:
        if not whole.get(entry.path):
            missing[entry.key].append(entry)
    return missing


def _read(url: RemoteUrl, remote: Remote) -> Snapshot:
    snapshot = remote.read()
    if snapshot is None:
        text = f"{remote.name} holds nothing that can be pulled"
        raise NotFoundError(f"{text}: check the name, or push there first")
    if url.kind not in (None, snapshot.manifest.kind):
        raise UsageError(f"{remote.name} holds a {snapshot.manifest.kind}, not a {url.kind}; check the name")
    return replace(snapshot, manifest=without_root_copies(snapshot.manifest)) if url.scheme == "hf" else snapshot


def _check_target(target: Path, manifest: Manifest, overwrite: bool) -> None:
    if not target.name:
        raise UsageError(f"{target} cannot be pulled to; name a new folder")
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise UsageError(f"{target} is not a folder; name a new one to pull to")
    if target.exists() and any(target.iterdir()) and not overwrite:
        raise FolderExistsError(target)
    beside = journals_of(target)
    if _has_journals(manifest) and beside.exists() and not overwrite and not _holds(beside, manifest):
        raise FolderExistsError(beside)
    target.parent.mkdir(parents=True, exist_ok=True)


def _check_space(folder: Path, size: int) -> None:
    free = shutil.disk_usage(folder).free
    if size > free:
        text = f"{folder.parent} has {free:,} bytes left, {size:,} are to be pulled"
        raise NoSpaceError(f"{text}; make room there, or pull to another disk: what has been transferred is kept")


def _move_to(tree: Path, target: Path, manifest: Manifest, overwrite: bool) -> None:
    """Rename the finished folder to the target; a dataset's journals first, as the dataset is the sign of success."""
    for checkpoints in [path for path in tree.rglob(CHECKPOINTS) if path.is_dir()]:
        name = newest(checkpoints)
        if name and not (checkpoints / LAST).exists():
            (checkpoints / LAST).symlink_to(name)
    if _has_journals(manifest):
        beside = journals_of(target)
        if _holds(beside, manifest):  # of a try that was killed right here
            shutil.rmtree(tree / JOURNALS)
        else:
            _rename(tree / JOURNALS, beside, overwrite)
    _rename(tree, target, overwrite)
    atomic.sync(target.parent)


def _rename(folder: Path, target: Path, overwrite: bool) -> None:
    if overwrite and target.is_dir():
        atomic._exchange(folder, target)  # pyright: ignore[reportPrivateUsage]
    else:
        atomic._rename(folder, target)  # pyright: ignore[reportPrivateUsage]


def _has_journals(manifest: Manifest) -> bool:
    return manifest.kind == "dataset" and any(entry.path.startswith(f"{JOURNALS}/") for entry in manifest.files)


def _holds(beside: Path, manifest: Manifest) -> bool:
    """Return whether a folder holds exactly the manifest's journals."""
    if not beside.is_dir():
        return False
    wanted = {path: entry for path, entry in manifest.by_path.items() if path.startswith(f"{JOURNALS}/")}
    found = {f"{JOURNALS}/{path.relative_to(beside).as_posix()}" for path in _leaves(beside)}
    return found == wanted.keys() and all(
        is_whole(entry, beside / path.removeprefix(f"{JOURNALS}/")) for path, entry in wanted.items()
    )


def _leaves(folder: Path) -> list[Path]:
    """Return everything below that is not a folder, links included; links are not followed."""
    return [path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()]
