"""Push a folder to a remote, and pull it back.

A push is checked first and is visible only when complete; a pull is verified, and its folder
appears in one rename.
"""

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
from manip_il.bridges.store.errors import RemoteError, explained
from manip_il.bridges.store.hub import Hub
from manip_il.bridges.store.manifest import (
    CARD,
    CHECKPOINTS,
    LAST,
    File,
    Kind,
    Manifest,
    PushPlan,
    datasets_in,
    list_files,
)
from manip_il.bridges.store.objects import Objects
from manip_il.data import atomic
from manip_il.data.atomic import DATASET, POLICY, kind_of, output_of
from manip_il.data.gate import check_arrived
from manip_il.data.lerobot_layout import INFO
from manip_il.errors import ManipError, UsageError

_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]*)://(.*[^/].*)")
_OF_A_RUN = ("config.yaml", "config.json", "eval.json", "checkpoints", "best")


def open_remote(
    url: str, *, revision: str | None = None, private: bool = False, quiet: bool = False
) -> Hub | Objects:
    """Return the remote of a URL, without connecting to it yet.

    Args:
        url: The address, such as `hf://datasets/USER/NAME` or `file://FOLDER`.
        revision: Branch, tag or commit on the Hub.
        private: Whether a push creates a private repository on the Hub.
        quiet: Whether to hide progress bars.

    Raises:
        UnknownName: if the scheme is unknown.
        UsageError: if the URL is invalid, or a revision is given for a remote other than the Hub.
    """
    found = _ADDRESS.fullmatch(url)
    if not found:
        raise UsageError(
            "the remote is not a URL; expected one such as hf://datasets/USER/NAME or file://FOLDER"
        )
    if found[1] == "hf":
        return Hub(found[2], revision, private=private, quiet=quiet)
    if revision is not None:
        raise UsageError(
            f"--revision={revision} is only for the Hub; other remotes hold one version"
        )
    return Objects(found[1], url, quiet=quiet)


def push(source: Path, remote: Hub | Objects, *, dry_run: bool = False) -> PushPlan:
    """Push a folder without its journals; return the differences.

    Args:
        source: A dataset, run or policy.
        remote: Where to.
        dry_run: Push nothing.

    Raises:
        ManipError: A check finds errors in the dataset, or in a dataset of the run.
        UsageError: It is neither, or a dataset is pushed to a policy's address or vice versa.
        RemoteError: The remote fails.
    """
    kind: Kind = "dataset" if (source / INFO).is_file() else "policy"
    if kind == "policy" and not any((source / name).exists() for name in _OF_A_RUN):
        text = f"neither a LeRobot dataset ({INFO}) nor a run or policy ({', '.join(_OF_A_RUN)})"
        raise UsageError(f"{source} is {text}; give one of these folders")
    before = None if remote.kind not in (None, kind) else remote.read()
    there = before.kind if before else remote.kind or kind
    if there != kind:
        text = "datasets go to hf://datasets/USER/NAME, runs to hf://USER/NAME"
        raise UsageError(f"{source} is a {kind}, but {remote.name} is for a {there}; {text}")
    for dataset in datasets_in(source):
        if errors := [finding for finding in examine_folder(dataset) if finding.is_error]:
            text = f"{dataset} is damaged and was not pushed: {errors[0]}"
            raise ManipError(f"{text}; see all errors with manip-il data check {dataset}")
    with tempfile.TemporaryDirectory(prefix="manip_il_card_") as folder:
        local = list_files(source.absolute())
        old = pushed = before.files if before else {}
        if isinstance(remote, Hub):  # other remotes hold the folder unchanged, and nothing else
            pushed = remote.pushed(before) if before else {}
            local = remote.with_card(
                source, local, Path(folder), keeps=CARD in old.keys() - pushed.keys()
            )
        with ThreadPoolExecutor() as pool:
            new = dict(zip(local, pool.map(File.of, local.values()), strict=True))
        same = {
            path
            for path in old.keys() & new.keys()
            if old[path] == new[path] or old[path].fits(local[path])
        }
        plan = PushPlan(
            manifest=Manifest(kind, new),
            before=before,
            local=local,
            upload=sorted(new.keys() - same),
            remove=sorted(old.keys() & pushed.keys() - new.keys()),
        )
        if not dry_run:
            remote.write(plan)
    return plan


def pull(
    remote: Hub | Objects, target: Path, *, overwrite: bool = False, dry_run: bool = False
) -> Manifest:
    """Download the remote's current version to `target`, completely or not at all.

    Return its manifest.

    Args:
        remote: Where from.
        target: The new folder.
        overwrite: Replace an existing folder, atomically.
        dry_run: Download nothing.

    Raises:
        FolderExistsError: The folder exists and may not be replaced.
        ManipError: `check_arrived` refuses a dataset.
        RemoteError: The remote fails, or holds nothing.
    """
    manifest = remote.read()
    if manifest is None or not manifest.files:
        text = (
            "check the address (of a dataset on the Hub: hf://datasets/USER/NAME), log in if it is"
            " private, or push"
        )
        raise RemoteError(f"{remote.name} holds nothing that can be pulled; {text} there first")
    files = {path: file for path, file in manifest.files.items() if path not in manifest.copies}
    manifest = replace(manifest, files=files)
    if dry_run:
        return manifest
    there = kind_of(target) or ""
    kind = there if there.startswith(output_of("")) else POLICY
    kind = DATASET if manifest.kind == "dataset" else kind
    with atomic.new_folder(target, replaces=kind if overwrite else "") as partial:
        _fetch(partial, remote, manifest)
        for checkpoints in partial.rglob(f"{CHECKPOINTS}/"):
            steps = [path.name for path in checkpoints.iterdir() if path.name.isdecimal()]
            if steps and not (checkpoints / LAST).exists():
                (checkpoints / LAST).symlink_to(max(steps, key=int))
    return manifest


def _fetch(folder: Path, remote: Hub | Objects, manifest: Manifest) -> None:
    """Download all files of a version into a folder, verify their hashes, and open datasets in a
    child process.
    """
    files = manifest.files
    for path in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
    with explained(f"pull from {remote.name}"), ThreadPoolExecutor(remote.at_once) as pool:
        arriving = pool.map(partial(remote.download, manifest, folder), files)
        list(
            tqdm(
                arriving, "pull", len(files), unit=" files", disable=True if remote.quiet else None
            )
        )
    # huggingface_hub's records of the download
    shutil.rmtree(folder / ".cache", ignore_errors=True)
    with ThreadPoolExecutor() as pool:
        for path, is_right in zip(
            files, pool.map(lambda path: files[path].fits(folder / path), files), strict=True
        ):
            if not is_right:
                text = f"{checks.shorten(path)} has the wrong hash; nothing was kept; pull again"
                raise RemoteError(f"{remote.name}: {text}, or push again, to an empty folder")
    for dataset in datasets_in(folder):
        check_arrived(dataset)
