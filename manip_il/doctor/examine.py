"""Examine a dataset by every check."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from manip_il import checks
from manip_il.data.dataset import Dataset
from manip_il.data.gate import check_arrived
from manip_il.data.lerobot_layout import INFO, STATS
from manip_il.doctor import files, motion, pictures
from manip_il.doctor.finding import ERROR, Finding, Severity, repair_it, restore
from manip_il.errors import ManipError

Check = Callable[[Dataset], Iterator[Finding]]
CHECKS: tuple[Check, ...] = (*files.CHECKS, *pictures.CHECKS, *motion.CHECKS)
_FILE = re.compile(r"(?:meta|data|videos)/[\w.\-/]*\w")
_ADVICE = re.compile(r"\W*(?:run|see)? ?`manip-il .*")  # of readers, to examine the dataset


def examine(root: Path, more: Sequence[Check] = ()) -> Iterator[Finding]:
    """Yield every finding, each once; none for a dataset that is whole. Raises nothing, whatever the folder holds.

    Every file is opened in a child process first; if that needs too much memory or time, or the folder is no dataset,
    this is the only finding. more: checks beside those of this room.
    """
    said: set[str] = set()
    try:
        check_arrived(root, strict=False)
        dataset = Dataset.open(root)
    except ManipError as problem:
        yield _explain(root, problem)
        return
    for check in (*CHECKS, *more):
        try:
            for finding in check(dataset):
                if str(finding) not in said:
                    yield finding
                said.add(str(finding))
        except Exception as problem:  # one check that fails must not hide the others
            if str(finding := _explain(root, problem)) not in said:
                yield finding
            said.add(str(finding))


def examine_folder(root: Path) -> list[Finding]:
    """Return all findings about a folder."""
    return list(examine(root))


def has_errors(findings: Sequence[Finding]) -> bool:
    """Return whether one of the findings is an error."""
    return any(finding.severity is ERROR for finding in findings)


def verdict(root: Path, findings: Sequence[Finding]) -> str:
    """Return one line: how many episodes and frames are whole, or how many errors and warnings there are."""
    severities = [finding.severity for finding in findings]
    counts = [f"{severities.count(kind)} {kind.value}(s)" for kind in Severity if kind in severities]
    if not has_errors(findings):
        info = Dataset.open(root).info
        counts.insert(0, f"{info.episodes:,} episodes, {info.frames:,} frames: whole")
    return f"{root}: {', '.join(counts)}"


def _explain(root: Path, problem: Exception) -> Finding:
    """Return what cannot be read, or a check that could not be finished, as a finding."""
    text = checks.one_line(problem) if isinstance(problem, ManipError) else f"check failed: {problem!r}"
    text = _ADVICE.sub("", text).replace(f"{root}/", "").removeprefix(f"{root}: ")
    place = found[0] if (found := _FILE.search(text)) else str(root)
    return Finding(ERROR, place, text, (repair_it if place in (INFO, STATS) else restore)(root))
