"""Push a folder to a remote, checked and visible only when complete; pull it back, verified, in one rename."""

from __future__ import annotations

import re
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from tqdm import tqdm

from manip_il import checks
from manip_il.bridges.doctor.examine import examine_folder
from manip_il.bridges.doctor.finding import NotWhole, journals_of
from manip_il.bridges.store.errors import RemoteError, explained
from manip_il.bridges.store.hub import Hub
from manip_il.bridges.store.manifest import (
    CARD,
    CHECKPOINTS,
    JOURNALS,
    LAST,
    File,
    Kind,
    Manifest,
    PushPlan,
    datasets_in,
    list_files,
    newest,
)
from manip_il.bridges.store.objects import Objects
from manip_il.data import atomic
from manip_il.data.gate import check_arrived
from manip_il.data.lerobot_layout import INFO
from manip_il.data.ownership import DATASET, EPISODES, POLICY, kind_of, output_of, require_replaceable
from manip_il.errors import UsageError

_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*)://(.*[^/].*)")
_OF_A_RUN = ("config.yaml", "config.json", "eval.json", "checkpoints", "best")


def open_remote(url: str, *, revision: str | None = None, private: bool = False, quiet: bool = False) -> Hub | Objects:
    """Return the remote of a URL, without connecting yet. Raises `UsageError` for an invalid URL.

    revision: branch, tag or commit on the Hub. private: whether a push creates a private repository on the Hub.
    """
    found = _ADDRESS.fullmatch(url)
    if not found:
        raise UsageError("the remote is not a URL; expected one such as hf://datasets/USER/NAME or file://FOLDER")
    if found[1] == "hf":
        return Hub(found[2], revision, private=private, quiet=quiet)
    if revision is not None:
        raise UsageError(f"--revision={revision} is only for the Hub; other remotes hold one version")
    return Objects(found[1], url, quiet=quiet)


def push(source: Path, remote: Hub | Objects, *, journals: bool = False, dry_run: bool = False) -> PushPlan:
    """Push a folder, or nothing if `dry_run`; return the differences.

    journals: push journals, too. Raises `NotWhole` if a check finds errors in the dataset, or in a dataset of the run,
    `UsageError` if a dataset is pushed to a policy's address or vice versa, and `RemoteError`.
    """
    kind: Kind = "dataset" if (source / INFO).is_file() else "policy"
    if kind == "policy" and not any((source / name).exists() for name in _OF_A_RUN):
        text = f"neither a LeRobot dataset ({INFO}) nor a run or policy ({', '.join(_OF_A_RUN)})"
        raise UsageError(f"{source} is {text}; give one of these folders")
    if remote.kind not in (None, kind):
        text = "datasets go to hf://datasets/USER/NAME, runs to hf://USER/NAME"
        raise UsageError(f"{source} is a {kind}, but {remote.name} is for a {remote.kind}; {text}")
    for dataset in datasets_in(source):
        if errors := [one for one in examine_folder(dataset) if one.is_error]:
            text = f"{dataset} is damaged and was not pushed: {' '.join(str(errors[0]).split())}"
            raise NotWhole(f"{text}; see all errors with manip-il data check, and try manip-il data repair {dataset}")
    with tempfile.TemporaryDirectory(prefix="manip_il_card_") as folder:
        local = list_files(source.absolute(), kind, journals=journals)
        before = remote.read()
        if before and before.kind != kind:
            raise UsageError(f"{remote.name} holds a {before.kind}, not a {kind}; choose another name")
        old, pushed = (before.files, remote.pushed(before)) if before else ({}, {})
        if isinstance(remote, Hub):  # other remotes hold the folder unchanged
            local = remote.with_card(source, local, Path(folder), keeps=CARD in old.keys() - pushed.keys())
        with ThreadPoolExecutor() as pool:
            manifest = Manifest(kind, dict(zip(local, pool.map(File.of, local.values()), strict=True)))
        new = manifest.files
        same = {path for path in old.keys() & new.keys() if old[path] == new[path] or old[path].fits(local[path])}
        plan = PushPlan(
            manifest, before, local, sorted(new.keys() - same), sorted(old.keys() & pushed.keys() - new.keys())
        )
        if not dry_run:
            remote.write(plan)
    return plan


def pull(remote: Hub | Objects, target: Path, *, overwrite: bool = False, dry_run: bool = False) -> Manifest:
    """Download the remote's current version to `target`, completely or not at all; return its manifest.

    overwrite: replace an existing folder, atomically. Raises `FolderExistsError` if a folder exists and may not be
    replaced, `ManipError` for a dataset that `check_arrived` refuses, and `RemoteError`.
    """
    manifest = remote.read()
    if manifest is None or not manifest.files:
        text = "check the address (of a dataset on the Hub: hf://datasets/USER/NAME), log in if it is private, or push"
        raise RemoteError(f"{remote.name} holds nothing that can be pulled; {text} there first")
    files = {path: file for path, file in manifest.files.items() if path not in manifest.copies}
    manifest = replace(manifest, files=files)
    if dry_run:
        return manifest
    beside, skip = journals_of(target), len(f"{JOURNALS}/")
    journals = {
        beside / path[skip:]: file
        for path, file in files.items()
        if manifest.kind == "dataset" and path.startswith(f"{JOURNALS}/")
    }
    there = {path for path in beside.rglob("*") if not path.is_dir()}
    if there == journals.keys() and all(file.fits(path) for path, file in journals.items()):
        journals = {}  # they are in place, as a killed pull leaves them
    if journals:
        require_replaceable(beside, EPISODES if overwrite else "")
    kind = kind_of(target) or ""
    kind = DATASET if manifest.kind == "dataset" else kind if kind.startswith(output_of("")) else POLICY
    with atomic.new_folder(target, replaces=kind if overwrite else "") as partial:
        _fetch(partial, remote, manifest)
        for checkpoints in [path for path in partial.rglob(CHECKPOINTS) if path.is_dir()]:
            if (name := newest(checkpoints)) and not (checkpoints / LAST).exists():
                (checkpoints / LAST).symlink_to(name)
        if journals:
            with atomic.new_folder(beside, replaces=EPISODES if overwrite else "") as folder:
                for path in list((partial / JOURNALS).iterdir()):
                    path.rename(folder / path.name)
        if manifest.kind == "dataset":
            shutil.rmtree(partial / JOURNALS, ignore_errors=True)
    return manifest


def _fetch(folder: Path, remote: Hub | Objects, manifest: Manifest) -> None:
    """Download all files of a version into a folder, verify their hashes, and open datasets in a child process."""
    files = manifest.files
    for path in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
    with explained(f"pull from {remote.name}"), ThreadPoolExecutor(remote.at_once) as pool:
        arriving = pool.map(partial(remote.download, manifest, folder), files)
        list(tqdm(arriving, "pull", len(files), unit=" files", disable=True if remote.quiet else None))
    shutil.rmtree(folder / ".cache", ignore_errors=True)  # huggingface_hub's records of the download
    with ThreadPoolExecutor() as pool:
        fits = pool.map(lambda path: files[path].fits(folder / path), files)
        wrong = next((path for path, is_right in zip(files, fits, strict=True) if not is_right), None)
    if wrong is not None:
        text = f"{checks.shorten(wrong)} has the wrong hash; nothing was kept; pull again"
        raise RemoteError(f"{remote.name}: {text}; if that does not help, push to an empty folder, and pull from there")
    for dataset in datasets_in(folder):
        check_arrived(dataset)
