"""What push, pull and cards share: the remote of a URL, and folders as they are pushed, with their files' hashes."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from manip_il.data.lerobot_layout import INFO
from manip_il.errors import UsageError
from manip_il.store.disk import HASHERS, hash_file
from manip_il.store.errors import ManifestError
from manip_il.store.manifest import FileEntry, Kind, Manifest, check_path, fold
from manip_il.store.remote import MANIFEST_FILE, Remote, RemoteUrl

CONFIG = "config.json"  # of every policy
CARD = "README.md"
JOURNALS = "journals"  # folder of a pushed dataset's journals; in a run every folder of that name holds some
CHECKPOINTS = "checkpoints"
LAST = "last"  # the link in `checkpoints` to the newest one: a pull makes it again
_LEFT_OUT = re.compile(r"\..*|.*\.(partial|incomplete|tmp)|__pycache__|" + re.escape(MANIFEST_FILE))
_POLICY_FILES = ("config.yaml", "config.json", "eval.json", CHECKPOINTS, "best")
_POLICY_FOLDERS = ("", "pretrained_model", "best/pretrained_model")
_CHECKPOINT = re.compile(rf"{CHECKPOINTS}/(\d+)/pretrained_model")


@dataclass(frozen=True)
class Scanned:
    """A folder's manifest, and its files by their paths in the manifest."""

    manifest: Manifest
    local: Mapping[str, Path]


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


def scan(root: Path, kind: Kind, *, journals: bool = False, extra: Mapping[str, Path] | None = None) -> Scanned:
    """Return every file of a dataset or of a run, hashed.

    journals: include a dataset's folder `<root>.journals` as `journals/`, and those inside a run. extra: files that
    replace the folder's own, by path. Hidden files and what a killed writer left are skipped. Raises `ManifestError`
    for links, and for what `FileEntry` refuses.
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

    def hashed(item: tuple[str, Path]) -> FileEntry:
        digest = hashlib.sha256()
        size = hash_file(item[1], digest)
        return FileEntry(item[0], size, digest.hexdigest())

    with ThreadPoolExecutor(HASHERS) as pool:
        entries = tuple(pool.map(hashed, sorted(local.items())))
    return Scanned(Manifest(kind, entries), local)


def journals_of(root: Path) -> Path:
    """Return the folder of a dataset's journals, beside it."""
    return root.absolute().with_name(f"{root.absolute().name}.{JOURNALS}")


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


def newest(checkpoints: Path) -> str | None:
    """Return the name of the checkpoint with the highest step."""
    steps = [path.name for path in checkpoints.iterdir() if path.name.isdecimal() and path.is_dir()]
    return max(steps, key=int, default=None)


def policy_folder(paths: Iterable[str]) -> str | None:
    """Return the folder of a run's policy among its files' `paths`: empty for the root, None without a policy.

    The best one, if the run has chosen it; else that of the newest checkpoint.
    """
    folders = {path.rpartition("/")[0] for path in paths if path.rpartition("/")[2] == CONFIG}
    for folder in _POLICY_FOLDERS:
        if folder in folders:
            return folder
    steps = {folder: int(found[1]) for folder in folders if (found := _CHECKPOINT.fullmatch(folder))}
    return max(steps, key=lambda folder: steps[folder], default=None)


def with_root_copies(scanned: Scanned) -> Scanned:
    """Return a run with copies of its policy's files at the root, where LeRobot looks for them on the Hub.

    The Hub stores equal bytes once. A run that has any file of such a name at its root is left as it is.
    """
    manifest = scanned.manifest
    inside = _policy_files(manifest)
    taken = {fold(path.partition("/")[0]) for path in manifest.by_path}
    if not inside or any(fold(name) in taken for name in inside):
        return scanned
    copies = tuple(replace(entry, path=name) for name, entry in inside.items())
    local = {**scanned.local, **{name: scanned.local[entry.path] for name, entry in inside.items()}}
    return Scanned(replace(manifest, files=manifest.files + copies), local)


def without_root_copies(manifest: Manifest) -> Manifest:
    """Return a run without the copies at its root, if all are there with the same bytes."""
    inside, there = _policy_files(manifest), manifest.by_path
    if any(name not in there or there[name].key != entry.key for name, entry in inside.items()):
        return manifest
    return replace(manifest, files=tuple(entry for entry in manifest.files if entry.path not in inside))


def _policy_files(manifest: Manifest) -> Mapping[str, FileEntry]:
    """Return name -> file of a run's policy; empty for a dataset, and for a policy that is at the root alone."""
    if manifest.kind != "policy":
        return {}
    folder = policy_folder(path for path in manifest.by_path if path != CONFIG)
    if folder is None:
        return {}
    start = f"{folder}/"
    inside = {path.removeprefix(start): entry for path, entry in manifest.by_path.items() if path.startswith(start)}
    return {name: entry for name, entry in inside.items() if "/" not in name and name != CARD}


def open_remote(url: RemoteUrl, *, private: bool = False) -> Remote:
    """Return the remote of a URL, without connecting yet; the library of its scheme is imported here.

    private: of a repository that a push creates on the Hub.
    """
    if url.scheme == "hf":
        from manip_il.store.hub import HubRemote

        return HubRemote(url, private)
    if url.scheme == "s3":
        from manip_il.store.s3_store import S3Blobs as Blobs
    elif url.scheme == "sftp":
        from manip_il.store.sftp_store import SftpBlobs as Blobs
    else:
        from manip_il.store.file_store import FileBlobs as Blobs
    from manip_il.store.object_store import ObjectRemote

    return ObjectRemote(Blobs(url))
