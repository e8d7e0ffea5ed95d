"""The policy of a run once more at the root of its repository on a Hub, where LeRobot looks for it; and a run without.

A Hub keeps equal bytes once, so the copies cost nothing there. A pull leaves them out: the run comes back as it was.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace

from manip_il.store.manifest import FileEntry, Manifest
from manip_il.store.paths import fold
from manip_il.store.scan import CHECKPOINTS, Scanned

CONFIG = "config.json"  # of every policy
CARD = "README.md"  # the root has one of its own
_FIRST = ("pretrained_model", "best/pretrained_model")
_CHECKPOINT = re.compile(rf"{CHECKPOINTS}/(\d+)/pretrained_model")


def policy_folder(paths: Iterable[str]) -> str | None:
    """Return where the policy of a run lies among its files' `paths`; empty for the root itself, None without a policy.

    The best one, where a run has chosen it; else that of the newest checkpoint.
    """
    folders = {path.rpartition("/")[0] for path in paths if path.rpartition("/")[2] == CONFIG}
    for folder in ("", *_FIRST):
        if folder in folders:
            return folder
    steps = {folder: int(found[1]) for folder in folders if (found := _CHECKPOINT.fullmatch(folder))}
    return max(steps, key=lambda folder: steps[folder], default=None)


def with_front(scanned: Scanned) -> Scanned:
    """Return a run with copies of its policy's files at the root.

    A folder that holds any file of such a name there itself is left as it is.
    """
    manifest = scanned.manifest
    inside = _inside(manifest)
    taken = {fold(path.partition("/")[0]) for path in manifest.by_path}
    if not inside or any(fold(name) in taken for name in inside):
        return scanned
    copies = tuple(replace(entry, path=name) for name, entry in inside.items())
    local = {**scanned.local, **{name: scanned.local[entry.path] for name, entry in inside.items()}}
    return Scanned(replace(manifest, files=manifest.files + copies), local)


def without_front(manifest: Manifest) -> Manifest:
    """Return a run without such copies: where all of them are there, and are the same bytes still."""
    inside = _inside(manifest)
    there = manifest.by_path
    if any(name not in there or there[name].key != entry.key for name, entry in inside.items()):
        return manifest
    return replace(manifest, files=tuple(entry for entry in manifest.files if entry.path not in inside))


def _inside(manifest: Manifest) -> Mapping[str, FileEntry]:
    """Name -> file of the policy of a run; empty for a dataset, and for a policy that lies at the root alone."""
    if manifest.kind != "policy":
        return {}
    folder = policy_folder(path for path in manifest.by_path if path != CONFIG)
    if folder is None:
        return {}
    inside = {path.removeprefix(f"{folder}/"): entry for path, entry in manifest.by_path.items()
              if path.startswith(f"{folder}/")}  # fmt: skip
    return {name: entry for name, entry in inside.items() if "/" not in name and name != CARD}
