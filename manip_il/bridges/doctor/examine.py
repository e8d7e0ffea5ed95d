"""Run every check on a dataset, and repair it from its journals or its own data."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from manip_il import checks
from manip_il.bridges.doctor import files, learning
from manip_il.bridges.doctor.finding import Finding, journals_of, mend
from manip_il.data.atomic import exclusive
from manip_il.data.build import build
from manip_il.data.dataset import Dataset
from manip_il.data.info import NUMBERS
from manip_il.data.lerobot_layout import DATA_FILES, EPISODE_INDEX, INFO, STATS, write_json
from manip_il.data.parquet_files import count_rows
from manip_il.data.statistics import Statistics, column_statistics, picture_statistics, to_lists
from manip_il.errors import ManipError

Check = Callable[[Dataset], Iterator[Finding]]
CHECKS: tuple[Check, ...] = (*files.CHECKS, *learning.CHECKS)
_FILE = re.compile(r"(?:meta|data|videos)/[\w.\-/]*\w")
_PICTURES = 100  # pictures per camera from which statistics are computed


def examine_folder(root: Path, more: Sequence[Check] = (), *, repaired: bool = False) -> list[Finding]:
    """Return all findings about a folder, [] for a sound dataset. Never raises.

    If the folder is not a dataset, this is the only finding. more: additional checks. repaired: whether it has just
    been repaired.
    """
    try:
        dataset = Dataset.open(root)
    except ManipError as problem:
        found = [_explain(root, problem)]
    else:
        found = [finding for check in (*CHECKS, *more) for finding in _run(check, dataset)]
    # several checks may report the same file
    return list(dict.fromkeys(replace(one, remedy=one.remedy or mend(root, one, repaired=repaired)) for one in found))


def _run(check: Check, dataset: Dataset) -> Iterator[Finding]:
    try:
        yield from check(dataset)
    except Exception as problem:  # a failing check must not hide the others
        yield _explain(dataset.root, problem)


def _explain(root: Path, problem: Exception) -> Finding:
    text = checks.one_line(problem) if isinstance(problem, ManipError) else f"a check failed: {problem!r}"
    text = text.partition("; run `manip-il data check")[0].replace(f"{root}/", "").removeprefix(f"{root}: ")
    text = text.replace("Parquet magic bytes not found in footer", "it has no footer, as after a crash of the recorder")
    place = [str(root), *_FILE.findall(text)][-1]  # the last path is the file's
    return Finding(place, text.replace(f"cannot read {place}: ", "cannot be read: "))


def has_errors(findings: Sequence[Finding]) -> bool:
    """Return whether one of the findings is an error."""
    return any(finding.is_error for finding in findings)


def repair(root: Path, findings: Sequence[Finding]) -> Iterator[str]:
    """Repair what can be repaired; yield one line for each repair, or for the reason why one was not possible.

    Nothing is deleted: replaced and moved files are kept in `ROOT.before-repair`. Raises `ManipError` if that exists,
    if a link leads outside, and while another process uses the dataset. Check the dataset again afterwards.
    """
    kept = root.with_name(f"{root.name}.before-repair")
    if kept.exists():
        raise ManipError(f"{kept} already exists, from an earlier repair; move it elsewhere first")
    if linked := [path for path in root.rglob("*") if not path.resolve().is_relative_to(root.resolve())]:
        raise ManipError(f"{linked[0]} is a link out of the dataset, which is not followed; repair a copy instead")
    with exclusive(root):
        if has_errors(findings) and journals_of(root).is_dir():
            yield _rebuild(root, kept)
        for path in files.leftovers(root):
            kept.mkdir(exist_ok=True)
            shutil.move(path, kept)
            yield f"moved away: {path.name}"
        for name, compute in ((INFO, _recount), (STATS, _recompute)):
            with suppress(ManipError, OSError, ValueError):  # unreadable files remain findings
                if content := compute(root):
                    kept.mkdir(exist_ok=True)
                    for path in root.glob(name):
                        shutil.copy2(path, kept)
                    write_json(root / name, content)
                    yield f"computed from the data: {name}"
        if kept.exists():
            yield f"replaced and moved files are kept in {kept}"


def _rebuild(root: Path, kept: Path) -> str:
    """Build the dataset from its journals, unless they hold fewer episodes than it does."""
    journals, fresh = journals_of(root), root.with_name(f".{root.name}.rebuilt.partial")
    held = 0  # if the dataset cannot be read
    with suppress(ManipError):
        held = len(np.unique(Dataset.open(root).columns([EPISODE_INDEX])[EPISODE_INDEX]))
    try:
        info, _ = build(journals, fresh, replace=True)
    except ManipError as problem:
        return f"not rebuilt: {problem}"
    if info.episodes < held:
        shutil.rmtree(fresh)
        return f"not rebuilt: {journals.name} holds {info.episodes} episodes, but {held} are still readable"
    with suppress(ManipError, LookupError):  # if the dataset cannot be read
        both = map(Dataset.open, (root, fresh))
        was, now = ((one.spec.robot, one.spec.fps, one.provenance["seeds"][0]) for one in both)
        if was != now:
            shutil.rmtree(fresh)
            return f"not rebuilt: {journals.name} holds another recording; move it elsewhere"
    root.rename(kept)
    fresh.rename(root)
    return f"rebuilt from {journals.name}: {info.episodes} episodes"


def _recount(root: Path) -> dict[str, Any]:
    """Return info.json with the actual counts of episodes, rows and tasks; {} if they are right."""
    dataset, about = Dataset.open(root), checks.read_json(root / INFO, "a dataset's description")
    rows = sum(count_rows(path) for path in root.glob(DATA_FILES))
    counts = {"total_episodes": len(dataset.episodes), "total_frames": rows, "total_tasks": len(dataset.tasks)}
    corrected = {**about, **counts, "splits": {"train": f"0:{len(dataset.episodes)}"}}
    return {} if about.items() >= counts.items() else corrected


def _recompute(root: Path) -> dict[str, Any]:
    """Return statistics of finite columns and, from some pictures, of cameras; {} if the stored ones are right."""
    if not any(finding.place.startswith(STATS) for finding in examine_folder(root)):
        return {}
    dataset, stats = Dataset.open(root), Statistics()
    rows = np.unique(np.linspace(0, len(dataset) - 1, _PICTURES).astype(np.int64))
    for key, feature in dataset.features.items():
        if feature.is_rgb:
            table = picture_statistics(dataset.frames(key, rows))
        elif feature.dtype in NUMBERS and np.isfinite(values := dataset.columns([key])[key]).all():
            table = column_statistics({key: values.reshape(-1, feature.shape[-1])})[key]
        else:
            continue
        stats[key] = {**table, "count": np.array([len(dataset)])}
    return to_lists(stats)
