"""The manifest of a local folder: what a push takes along."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from manip_il.data.lerobot_layout import INFO
from manip_il.errors import UsageError
from manip_il.store.disk import hash_file
from manip_il.store.errors import ManifestError
from manip_il.store.manifest import FileEntry, Kind, Manifest
from manip_il.store.paths import check_path
from manip_il.store.remote import MANIFEST_FILE

JOURNALS = "journals"  # folder of a pushed dataset's journals; in a run every folder of that name holds some
LAST = "last"  # the link in `checkpoints` to the newest one: a pull makes it again
CHECKPOINTS = "checkpoints"
HASHERS = 4  # threads: hashlib lets go of Python's lock
_LEFT_OUT = re.compile(r"\..*|.*\.(partial|incomplete|tmp)|__pycache__|" + re.escape(MANIFEST_FILE))
_POLICY_FILES = ("config.yaml", "config.json", "eval.json", CHECKPOINTS, "best")


@dataclass(frozen=True)
class Scanned:
    """A manifest, and where its files lie."""

    manifest: Manifest
    local: Mapping[str, Path]


def scan(root: Path, kind: Kind, *, journals: bool = False, extra: Mapping[str, Path] | None = None) -> Scanned:
    """Return every file of a dataset or of a run, hashed.

    journals: a dataset's folder `<root>.journals` goes along as `journals/`, and those inside a run. extra: files that
    take the place of the folder's own, by path. Left out is what begins with a dot and what a killed writer left.
    Raises `ManifestError` for links, and for what `FileEntry` refuses.
    """
    local = _below(root, journals)
    if journals and kind == "dataset":
        beside = root.absolute().with_name(f"{root.absolute().name}.{JOURNALS}")
        if beside.is_dir():
            local |= {f"{JOURNALS}/{name}": path for name, path in _below(beside, journals).items()}
    local |= extra or {}
    if not local:
        raise ManifestError(f"{root} holds no file to push; expected a dataset or a run")
    for path in local:
        check_path(path)
    with ThreadPoolExecutor(HASHERS) as pool:
        entries = tuple(pool.map(lambda item: entry_of(*item), sorted(local.items())))
    return Scanned(Manifest(kind, entries), local)


def kind_of(root: Path) -> Kind:
    """What a folder holds; `UsageError` where it is neither."""
    if not root.is_dir():
        raise UsageError(f"{root} is not a folder; expected the folder of a dataset or of a run")
    if (root / INFO).is_file():
        return "dataset"
    if any((root / name).exists() for name in _POLICY_FILES):
        return "policy"
    text = f"{root} is neither a LeRobot dataset ({INFO}) nor a run or policy ({', '.join(_POLICY_FILES)})"
    raise UsageError(f"{text}; name the folder that holds one")


def entry_of(name: str, path: Path) -> FileEntry:
    """Return the entry of a local file."""
    digest = hashlib.sha256()
    size = hash_file(path, digest)
    return FileEntry(name, size, digest.hexdigest())


def is_left_out(name: str) -> bool:
    """Return whether no push takes a file or folder of this name along."""
    return bool(_LEFT_OUT.fullmatch(name))


def _below(folder: Path, journals: bool) -> dict[str, Path]:
    """Files by their paths inside a folder."""
    folder = folder.absolute()
    start = len(f"{folder}/")  # a slice is ten times as quick as `relative_to`
    return {str(path)[start:]: path for path in _files(folder, journals)}


def _files(folder: Path, journals: bool) -> Iterator[Path]:
    with os.scandir(folder) as found:
        entries = sorted(found, key=lambda entry: entry.name)
    for entry in entries:
        path = Path(entry.path)
        if is_left_out(entry.name) or (entry.name == JOURNALS and not journals and entry.is_dir()):
            continue
        if entry.is_symlink():
            if not _is_last(path):
                raise ManifestError(f"{path} is a link; links are not pushed: replace it with the file itself")
        elif entry.is_dir():
            yield from _files(path, journals)
        elif entry.is_file():
            yield path
        else:
            raise ManifestError(f"{path} is not a regular file; move it out of the folder")


def _is_last(path: Path) -> bool:
    """Whether it is LeRobot's `checkpoints/last`, a link to the newest checkpoint beside it."""
    return path.name == LAST and path.parent.name == CHECKPOINTS and os.readlink(path) == newest(path.parent)


def newest(checkpoints: Path) -> str | None:
    """Name of the checkpoint with the highest step."""
    steps = [path.name for path in checkpoints.iterdir() if path.name.isdecimal() and path.is_dir()]
    return max(steps, key=int, default=None)
