"""A folder to a remote: checked, listed, uploaded, and only then seen."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from manip_il.data.lerobot_layout import INFO
from manip_il.doctor.examine import examine_folder, has_errors
from manip_il.doctor.finding import NotWhole, Severity
from manip_il.errors import UsageError
from manip_il.store.front import with_front
from manip_il.store.landing import is_whole
from manip_il.store.manifest import Kind, Manifest
from manip_il.store.remote import Advance, Published, Remote, Snapshot
from manip_il.store.scan import Scanned, is_left_out, kind_of, scan
from manip_il.store.url import RemoteUrl

Progress = Callable[[int, str], AbstractContextManager[Advance]]  # total [bytes] and what it is of


@dataclass(frozen=True)
class Plan:
    """What a push will do. upload: files of which the remote lacks the bytes; size: of those [bytes]."""

    manifest: Manifest
    before: Snapshot | None
    upload: tuple[str, ...]
    size: int
    remove: tuple[str, ...]


def push(
    source: Path, url: RemoteUrl, remote: Remote, progress: Progress, *, journals: bool = False, dry_run: bool = False
) -> tuple[Plan, Published | None]:
    """What was to be done, and what was; nothing with `dry_run`.

    A dataset that the doctor finds errors in is refused (`NotWhole`), in a run too; one kind over the other is not
    pushed either (`UsageError`).
    """
    kind = check_source(source, url)
    with tempfile.TemporaryDirectory(prefix="manip_il_card_") as folder:
        extra = _cards(source, kind, url, Path(folder))
        scanned = scan(source, kind, journals=journals, extra=extra)
        if url.scheme == "hf":
            scanned = with_front(scanned)
        before = remote.read()
        plan = make_plan(scanned, before, remote.describe())
        if dry_run:
            return plan, None
        with progress(plan.size, "push") as advance:
            return plan, remote.publish(scanned.local, scanned.manifest, before, advance)


def check_source(source: Path, url: RemoteUrl) -> Kind:
    """What `source` holds, where it may be pushed to `url`."""
    kind = kind_of(source)
    if url.kind not in (None, kind):
        place = url.place
        right = f"hf://datasets/{place}" if kind == "dataset" else f"hf://{place}"
        raise UsageError(f"{source} is a {kind}, {url} is for a {url.kind}; push it to {right}")
    for dataset in _datasets(source):
        findings = examine_folder(dataset)
        if has_errors(findings):
            first = next(finding for finding in findings if finding.severity is Severity.ERROR)
            text = f"{dataset} is damaged and was not pushed: {' '.join(str(first).split())}"
            raise NotWhole(f"{text}; see all with manip-il doctor {dataset}, and repair it with --repair=true")
    return kind


def _datasets(source: Path) -> Iterator[Path]:
    """Folders of datasets: `source` itself, or those of a run's rounds."""
    for folder, names, _ in os.walk(source):
        names[:] = sorted(name for name in names if not is_left_out(name))
        if (Path(folder) / INFO).is_file():
            names.clear()
            yield Path(folder)


def make_plan(scanned: Scanned, before: Snapshot | None, place: str) -> Plan:
    """Return the difference between a folder and what is there. Raises `UsageError` where another kind is there."""
    manifest = scanned.manifest
    if before and before.manifest.kind != manifest.kind:
        there, here = before.manifest.kind, manifest.kind
        raise UsageError(f"{place} holds a {there}; a {here} cannot replace it: choose another name")
    old = before.manifest.by_path if before else {}
    known = before.manifest.keys if before else frozenset[str]()
    new = [entry for entry in manifest.files if not _is_known(entry.path, entry.key, known, before, scanned)]
    gone = tuple(path for path in old if path not in manifest.by_path)
    return Plan(manifest, before, tuple(entry.path for entry in new), sum(entry.size for entry in new), gone)


def _is_known(path: str, key: str, known: frozenset[str], before: Snapshot | None, scanned: Scanned) -> bool:
    """Whether the remote has these bytes; where it says only git's hash of a file, the same is computed here."""
    if key in known:
        return True
    there = before.manifest.by_path.get(path) if before else None
    return there is not None and not there.sha256 and is_whole(there, scanned.local[path])


def _cards(source: Path, kind: Kind, url: RemoteUrl, folder: Path) -> dict[str, Path]:
    """Files that the Hub shows a visitor; other stores show none, and keep the folder byte for byte."""
    if url.scheme != "hf":
        return {}
    from manip_il.store.cards import card_for

    paths: dict[str, Path] = {}
    for number, (name, data) in enumerate(card_for(source, kind, str(url)).items()):
        paths[name] = folder / str(number)
        paths[name].write_bytes(data)
    return paths
