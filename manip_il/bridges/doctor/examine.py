"""Run every check on a dataset, and repair what follows from its data."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from manip_il import checks
from manip_il.bridges.doctor import files, learning
from manip_il.bridges.doctor.files import Finding
from manip_il.data.atomic import exclusive
from manip_il.data.dataset import Dataset
from manip_il.data.info import NUMBERS
from manip_il.data.lerobot_layout import DATA_FILES, INFO, STATS, write_json
from manip_il.data.parquet_files import count_rows
from manip_il.data.statistics import Statistics, column_statistics, picture_statistics, to_lists
from manip_il.errors import ManipError, UsageError

Check = Callable[[Dataset], Iterator[Finding]]
CHECKS: tuple[Check, ...] = (*files.CHECKS, *learning.CHECKS)
_PICTURES = 100  # pictures per camera from which statistics are computed


def examine_folder(root: Path, more: Sequence[Check] = ()) -> list[Finding]:
    """Return all findings about a folder, [] for a sound dataset.

    If the folder is not a dataset, this is the only finding. Raises only `UsageError`, if there is
    no such folder.

    Args:
        root: The folder.
        more: Checks to run in addition to `CHECKS`.
    """
    found: list[Finding] = []
    try:
        dataset = Dataset.open(root)
        for check in (*CHECKS, *more):
            try:
                found += check(dataset)
            except Exception as problem:  # a failing check must not hide the others
                found.append(_explain(root, problem))
    except UsageError:
        raise
    except ManipError as problem:
        found.append(_explain(root, problem))
    return list(dict.fromkeys(found))  # several checks may report the same file


def _explain(root: Path, problem: Exception) -> Finding:
    is_known = isinstance(problem, ManipError)
    text = checks.one_line(problem) if is_known else f"a check failed: {problem!r}"
    text = text.partition("; run `manip-il data check")[0]
    return Finding(str(root), text.removeprefix(f"{root}: "))


def repair(root: Path) -> Iterator[str]:
    """Compute counts and statistics again if they are wrong; yield one line for each repair.

    Nothing is deleted: replaced files are kept in `ROOT.before-repair`. Check the dataset again
    afterwards.

    Raises:
        ManipError: if `ROOT.before-repair` exists, if a link leads outside, or while another
            process uses the dataset.
    """
    kept = root.with_name(f"{root.name}.before-repair")
    if kept.exists():
        raise ManipError(f"{kept} already exists, from an earlier repair; move it elsewhere first")
    if linked := [
        path for path in root.rglob("*") if not path.resolve().is_relative_to(root.resolve())
    ]:
        raise ManipError(
            f"{linked[0]} is a link out of the dataset, which is not followed; repair a copy"
            " instead"
        )
    with exclusive(root):
        for name, compute in ((INFO, _recount), (STATS, _recompute)):
            with suppress(ManipError, OSError, ValueError):  # unreadable files remain findings
                if content := compute(root):
                    kept.mkdir(exist_ok=True)
                    if (root / name).exists():
                        shutil.copy2(root / name, kept)
                    write_json(root / name, content)
                    yield f"computed from the data: {name}"
        if kept.exists():
            yield f"replaced files are kept in {kept}"


def _recount(root: Path) -> dict[str, Any]:
    """Return info.json with the actual counts of episodes, rows and tasks; {} if they are right."""
    dataset, about = Dataset.open(root), checks.read_json(root / INFO, "a dataset's description")
    episodes = len(dataset.episodes)
    rows = sum(map(count_rows, root.glob(DATA_FILES)))
    counts = {"total_episodes": episodes, "total_frames": rows, "total_tasks": len(dataset.tasks)}
    is_right = about.items() >= counts.items()
    return {} if is_right else {**about, **counts, "splits": {"train": f"0:{episodes}"}}


def _recompute(root: Path) -> dict[str, Any]:
    """Return statistics of finite columns and, from some pictures, of cameras.

    {} if the stored ones are right.
    """
    if not any(STATS in str(finding) for finding in examine_folder(root)):
        return {}
    dataset, stats = Dataset.open(root), Statistics()
    rows = np.unique(np.linspace(0, len(dataset) - 1, _PICTURES).astype(np.int64))
    for key, feature in dataset.features.items():
        if feature.is_rgb:
            stats[key] = picture_statistics(dataset.frames(key, rows)) | {
                "count": np.array([len(dataset)])
            }
        elif feature.dtype in NUMBERS:
            values = dataset.columns([key])[key].reshape(-1, feature.shape[-1])
            if np.isfinite(values).all():
                stats |= column_statistics({key: values})
    return to_lists(stats)
