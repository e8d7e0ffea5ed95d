"""What a command is given, judged by its files alone: a wrong path is said before anything heavy is imported."""

from __future__ import annotations

import re
from pathlib import Path

from manip_il.cli.folders import check_output
from manip_il.errors import FolderExistsError, UsageError

_REPO = re.compile(r"[A-Za-z0-9_][\w.-]*/[A-Za-z0-9_][\w.-]*")


def require_dataset(root: Path) -> None:
    """Raise `UsageError` unless `root` is a folder with a LeRobot dataset's `meta/info.json`."""
    if not root.exists():
        hint = hub_hint(root, "datasets/")
        raise UsageError(f"{root} does not exist; expected the folder of a LeRobot dataset{hint}")
    if not (root / "meta" / "info.json").is_file():
        raise UsageError(f"{root} is not a LeRobot dataset: it has no meta/info.json{_inside(root)}")


def require_eval(path: Path) -> None:
    """Raise `UsageError` unless `path` is a file, an `eval.json`, or a folder that holds one."""
    if not path.exists():
        raise UsageError(f"{path} does not exist; expected an eval.json of manip-il eval, or its folder")
    if path.is_dir() and not (path / "eval.json").is_file():
        raise UsageError(f"{path} holds no eval.json; expected the folder of a finished manip-il eval")


def require_folder(path: Path, what: str) -> None:
    """Raise `UsageError` unless there is such a folder. what: it should be."""
    if not path.is_dir():
        raise UsageError(f"{path} {'is not a folder' if path.exists() else 'does not exist'}; expected {what}")


def require_workers(workers: int | None) -> None:
    """Raise `UsageError` for less than one process."""
    if workers is not None and workers < 1:
        raise UsageError(f"--workers is {workers}; expected at least 1")


def require_output(folder: Path, command: str, *, resume: bool = False, overwrite: bool = False) -> None:
    """Raise `UsageError` where a command cannot begin to write to `folder`, or has nothing in it to resume."""
    check_output(folder, resume=resume, overwrite=overwrite)
    if resume and not (folder.is_dir() and any(folder.iterdir())):
        raise UsageError(
            f"--resume=true: nothing to resume in {folder}; expected what an earlier manip-il {command} left there "
            "(leave out --resume=true to start)"
        )


def require_new(folder: Path, *, overwrite: bool = False) -> None:
    """Raise `UsageError` where a command that cannot be resumed may not write to `folder`."""
    try:
        check_output(folder, resume=False, overwrite=overwrite)
    except FolderExistsError:
        raise UsageError(f"{folder} exists already; replace it with --overwrite=true") from None


def hub_hint(path: Path, kind: str = "") -> str:
    """Return how to pull what looks like a repo on the Hub, as it is no path here; else nothing. kind: `datasets/`."""
    if path.exists() or path.parent.exists() or not _REPO.fullmatch(str(path)):
        return ""
    return f"; if it is on the Hub, get it by manip-il pull hf://{kind}{path} FOLDER and give that FOLDER"


def _inside(root: Path) -> str:
    """Which datasets lie in a folder that is none itself, where it holds some."""
    found = sorted(path.parents[1].name for path in root.glob("*/meta/info.json")) if root.is_dir() else []
    return f"; it holds the datasets {', '.join(found[:3])}{' ...' if len(found) > 3 else ''}" if found else ""
