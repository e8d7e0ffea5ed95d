"""Whether this program made a folder, and of which kind it is: known by what it wrote into it.

Everything that replaces, empties or adds to a folder asks here first.
"""

from __future__ import annotations

import re
from pathlib import Path

from manip_il import checks
from manip_il.errors import FolderExistsError, UsageError

PARTIAL = ".partial"  # suffix of unfinished files and folders
UNFINISHED_MARK = ".manip_il_unfinished"  # file in the folder around one that is being written
CONFIG_FILE, CONFIG_HEADER = "config.yaml", "# manip-il"  # options of a command, and how their first line begins
DATASET = "a dataset"
EPISODES = "journals"
POLICY = "a policy"
CHECKPOINT = "a checkpoint"
UNFINISHED = "an unfinished folder"

_OPTIONS = re.compile(rf"{CONFIG_HEADER} .*\((\w+)\)\n".encode())


def output_of(options: str) -> str:
    """Return the kind of the folder that holds a command's options. options: name of their class."""
    command = options.removesuffix("Options").lower()
    return EPISODES if command == "record" else f"the output of manip-il {command}"


_MARKS = (  # kind, file and a text in it that only we write
    (UNFINISHED, UNFINISHED_MARK, b""),
    (DATASET, "meta/manip_il.json", b'"fingerprint"'),
    (DATASET, "meta/info.json", b'"executed_action"'),  # imported from the MCAP files of a dataset
    (EPISODES, "recording.json", b'"only_successes"'),
    (POLICY, "manip_il.json", b'"action_meaning"'),
    (CHECKPOINT, "pretrained_model/config.json", b'"type"'),  # perhaps a copy of somebody's policy, in a run of ours
    (output_of("Dagger"), "settings.json", b'"label_budget"'),  # a run from Python, as in the next two
    (output_of("Train"), "metrics.jsonl", b'"samples_per_s"'),
    (output_of("Eval"), "eval.json", b'"fingerprint"'),
)


def kind_of(folder: Path) -> str | None:
    """Return the kind of a folder that this program made; "" if there is none yet, None if somebody else made it.

    A folder that holds at most unfinished files counts as none.
    """
    if not folder.is_dir():
        return None if folder.exists(follow_symlinks=False) else ""
    if all(path.name.startswith(".") and path.name.endswith(PARTIAL) for path in folder.iterdir()):
        return ""
    options = folder / CONFIG_FILE
    if options.is_file() and (made_by := _OPTIONS.match(checks.read_bytes(options, "options"))):
        return output_of(made_by[1].decode())
    for kind, name, mark in _MARKS:
        if (folder / name).is_file() and mark in checks.read_bytes(folder / name, kind):
            return kind
    return None


def is_our_file(path: Path) -> bool:
    """Return whether a file names this program, as each single file that a command writes does."""
    return path.is_file() and re.search(rb"manip[-_]il", checks.read_bytes(path, "a file")) is not None


def require_ours(folder: Path, kind: str) -> None:
    """Raise `UsageError` unless there is nothing at `folder`, or a folder of this kind."""
    there = kind_of(folder)
    if there not in ("", kind):
        found = there or "files that manip-il did not make"
        raise UsageError(f"{folder} holds {found}; expected {kind} or an empty folder: choose another folder")


def require_replaceable(folder: Path, kind: str = "") -> None:
    """Raise `UsageError` unless there is nothing at `folder`, or a folder of this kind and no link to one.

    Without a kind, raises `FolderExistsError` for anything that is there.
    """
    if kind_of(folder) == "":
        return
    if not kind:
        raise FolderExistsError(folder)
    if folder.is_symlink():
        raise UsageError(f"{folder} is a link, which is not followed to replace files; give {folder.resolve()}")
    require_ours(folder, kind)
