"""A folder to a remote: checked, listed, uploaded, and only then visible."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from manip_il.doctor.examine import examine_folder
from manip_il.doctor.finding import NotWhole, Severity
from manip_il.errors import UsageError
from manip_il.store.disk import is_whole
from manip_il.store.folder import Scanned, datasets_in, kind_of, scan, with_root_copies
from manip_il.store.manifest import FileEntry, Kind, Manifest
from manip_il.store.remote import Progress, Published, Remote, RemoteUrl, Snapshot


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
        if url.scheme == "hf":
            cards = _write_cards(source, kind, url, Path(folder))
            scanned = with_root_copies(scan(source, kind, journals=journals, extra=cards))
        else:  # other stores keep the folder byte for byte, without a card
            scanned = scan(source, kind, journals=journals)
        before = remote.read()
        plan = make_plan(scanned, before, remote.name)
        if dry_run:
            return plan, None
        with progress(plan.size, "push") as advance:
            return plan, remote.publish(scanned.local, scanned.manifest, before, advance)


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
