"""A folder to a remote: checked, listed, uploaded, and only then visible."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from manip_il.data.lerobot_layout import INFO
from manip_il.doctor.examine import examine_folder
from manip_il.doctor.finding import NotWhole, Severity
from manip_il.errors import UsageError
from manip_il.store.disk import HASHERS, is_whole, sized_and_hashed
from manip_il.store.errors import ManifestError
from manip_il.store.manifest import (
    CHECKPOINTS,
    JOURNALS,
    LAST,
    FileEntry,
    Kind,
    Manifest,
    check_path,
    check_together,
    fold,
    journals_of,
    newest,
    policy_files,
)
from manip_il.store.remote import MANIFEST_FILE, Advance, Intake, Progress, Published, Remote, RemoteUrl, Snapshot

_LEFT_OUT = re.compile(r"\..*|.*\.(partial|incomplete|tmp)|__pycache__|" + re.escape(MANIFEST_FILE))
_POLICY_FILES = ("config.yaml", "config.json", "eval.json", CHECKPOINTS, "best")


@dataclass(frozen=True)
class Scanned:
    """A folder's manifest, and its files by their paths in the manifest."""

    manifest: Manifest
    local: Mapping[str, Path]


@dataclass(frozen=True)
class Plan:
    """Difference between a folder and the remote. upload: files that the remote lacks; size: of those [bytes]."""

    manifest: Manifest
    before: Snapshot | None
    upload: tuple[str, ...]
    size: int
    remove: tuple[str, ...]


def push(
    source: Path, url: RemoteUrl, remote: Remote, progress: Progress, *, journals: bool = False, dry_run: bool = False
) -> tuple[Plan, Published | None]:
    """Push a folder; return the plan and, without `dry_run`, the result.

    Raises `NotWhole` for a dataset in which the doctor finds errors, in a run too, and `UsageError` for a dataset in
    place of a policy or the other way round.
    """
    kind = check_source(source, url)
    with tempfile.TemporaryDirectory(prefix="manip_il_card_") as folder:
        is_hub = url.scheme == "hf"  # other stores keep the folder byte for byte, without a card
        cards = _write_cards(source, kind, url, Path(folder)) if is_hub else {}
        local, before = list_files(source, kind, journals=journals, extra=cards), remote.read()
        size = sum(path.stat().st_size for path in local.values())
        if not dry_run and (take := remote.intake(before, size)):
            with progress(size, "push") as advance:
                scanned = hash_files(local, kind, lambda path: _advanced(take(path), advance))
                published = remote.publish(local, scanned.manifest, before, lambda _: None)
            return make_plan(scanned, before, remote.name), published
        scanned = hash_files(local, kind)
        if is_hub:
            scanned = with_root_copies(scanned)
        plan = make_plan(scanned, before, remote.name)
        if dry_run:
            return plan, None
        with progress(plan.size, "push") as advance:
            return plan, remote.publish(scanned.local, scanned.manifest, before, advance)


def _advanced(taken: tuple[int, str], advance: Advance) -> tuple[int, str]:
    advance(taken[0])
    return taken


def check_source(source: Path, url: RemoteUrl) -> Kind:
    """Return what `source` holds, if it may be pushed to `url`. Raises as `push` does."""
    kind = kind_of(source)
    if url.kind not in (None, kind):
        right = RemoteUrl("hf", url.place, kind)
        raise UsageError(f"{source} is a {kind}, {url} is for a {url.kind}; push it to {right}")
    for dataset in datasets_in(source):
        first = next((finding for finding in examine_folder(dataset) if finding.severity is Severity.ERROR), None)
        if first is not None:
            text = f"{dataset} is damaged and was not pushed: {' '.join(str(first).split())}"
            raise NotWhole(f"{text}; see all with manip-il doctor {dataset}, and repair it with --repair=true")
    return kind


def _write_cards(source: Path, kind: Kind, url: RemoteUrl, folder: Path) -> dict[str, Path]:
    """Write the files that the Hub shows to a visitor into `folder`; return them by their paths in the repository."""
    from manip_il.store.cards import card_for  # here: no other remote needs huggingface_hub

    paths: dict[str, Path] = {}
    for number, (name, data) in enumerate(card_for(source, kind, str(url)).items()):
        paths[name] = folder / str(number)
        paths[name].write_bytes(data)
    return paths


def make_plan(scanned: Scanned, before: Snapshot | None, place: str) -> Plan:
    """Compare a folder with the version on the remote. Raises `UsageError` if another kind is there."""
    manifest = scanned.manifest
    if before and before.manifest.kind != manifest.kind:
        there, here = before.manifest.kind, manifest.kind
        raise UsageError(f"{place} holds a {there}; a {here} cannot replace it: choose another name")
    old = before.manifest.by_path if before else {}
    known = before.manifest.keys if before else frozenset[str]()

    def is_known(entry: FileEntry) -> bool:
        """Return whether the remote has these bytes; if it says only git's hash of a file, this computes it here."""
        there = old.get(entry.path)
        return entry.key in known or bool(there and not there.sha256 and is_whole(there, scanned.local[entry.path]))

    new = [entry for entry in manifest.files if not is_known(entry)]
    gone = tuple(path for path in old if path not in manifest.by_path)
    return Plan(manifest, before, tuple(entry.path for entry in new), sum(entry.size for entry in new), gone)


def kind_of(root: Path) -> Kind:
    """Return what a folder holds. Raises `UsageError` if it is neither a dataset nor a run."""
    if not root.is_dir():
        raise UsageError(f"{root} is not a folder; expected the folder of a dataset or of a run")
    if (root / INFO).is_file():
        return "dataset"
    if any((root / name).exists() for name in _POLICY_FILES):
        return "policy"
    text = f"{root} is neither a LeRobot dataset ({INFO}) nor a run or policy ({', '.join(_POLICY_FILES)})"
    raise UsageError(f"{text}; name the folder that holds one")


def datasets_in(source: Path) -> Iterator[Path]:
    """Yield the folders of datasets: `source` itself, or those of a run's rounds."""
    for folder, names, _ in os.walk(source):
        names[:] = sorted(name for name in names if not _LEFT_OUT.fullmatch(name))
        if (Path(folder) / INFO).is_file():
            names.clear()
            yield Path(folder)


def list_files(
    root: Path, kind: Kind, *, journals: bool = False, extra: Mapping[str, Path] | None = None
) -> dict[str, Path]:
    """Return every file of a dataset or of a run by its path in the manifest.

    journals: include a dataset's folder `<root>.journals` as `journals/`, and those inside a run. extra: files that
    replace the folder's own, by path. Hidden files and what a killed writer left are skipped. Raises `ManifestError`
    for links, and for paths that `FileEntry` refuses.
    """
    local = _files_below(root, journals)
    if journals and kind == "dataset":
        beside = journals_of(root)
        if beside.is_dir():
            local |= {f"{JOURNALS}/{name}": path for name, path in _files_below(beside, journals).items()}
    local |= extra or {}
    if not local:
        raise ManifestError(f"{root} holds no file to push; expected a dataset or a run")
    for path in local:
        check_path(path)
    check_together(local)
    return local


def scan(root: Path, kind: Kind, *, journals: bool = False) -> Scanned:
    """Return every file of `list_files`, hashed."""
    return hash_files(list_files(root, kind, journals=journals), kind)


def hash_files(local: Mapping[str, Path], kind: Kind, hashed: Intake = sized_and_hashed) -> Scanned:
    """Return the manifest of files, by their paths. hashed: gives a file's size [bytes] and sha256."""

    def entry(item: tuple[str, Path]) -> FileEntry:
        return FileEntry(item[0], *hashed(item[1]))

    with ThreadPoolExecutor(HASHERS) as pool:
        entries = tuple(pool.map(entry, sorted(local.items())))
    return Scanned(Manifest(kind, entries), local)


def _files_below(folder: Path, journals: bool) -> dict[str, Path]:
    """Return files by their paths inside a folder."""
    folder = folder.absolute()
    start = len(f"{folder}/")  # a slice is ten times as quick as `relative_to`
    return {str(path)[start:]: path for path in _walk(folder, journals)}


def _walk(folder: Path, journals: bool) -> Iterator[Path]:
    with os.scandir(folder) as found:
        entries = sorted(found, key=lambda entry: entry.name)
    for entry in entries:
        path = Path(entry.path)
        if _LEFT_OUT.fullmatch(entry.name) or (entry.name == JOURNALS and not journals and entry.is_dir()):
            continue
        if entry.is_symlink():
            is_last = (path.parent.name, path.name) == (CHECKPOINTS, LAST)
            if not is_last or os.readlink(path) != newest(path.parent):
                raise ManifestError(f"{path} is a link; links are not pushed: replace it with the file itself")
        elif entry.is_dir():
            yield from _walk(path, journals)
        elif entry.is_file():
            yield path
        else:
            raise ManifestError(f"{path} is not a regular file; move it out of the folder")


def with_root_copies(scanned: Scanned) -> Scanned:
    """Return a run with copies of its policy's files at the root, where LeRobot looks for them on the Hub.

    The Hub stores equal bytes once. A run that has any file of such a name at its root is left as it is.
    """
    manifest = scanned.manifest
    inside = policy_files(manifest)
    taken = {fold(path.partition("/")[0]) for path in manifest.by_path}
    if not inside or any(fold(name) in taken for name in inside):
        return scanned
    copies = tuple(replace(entry, path=name) for name, entry in inside.items())
    local = {**scanned.local, **{name: scanned.local[entry.path] for name, entry in inside.items()}}
    return Scanned(replace(manifest, files=manifest.files + copies), local)
