"""The list of checks, and a run through it that nothing a folder holds can stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, Remedy, Severity, count_frames, count_text, error
from manip_il.doctor.journals import check_journals
from manip_il.doctor.leftovers import check_leftovers, check_stale_files
from manip_il.doctor.meta import check_episodes, check_footers, check_info, check_tasks
from manip_il.doctor.ours import check_fingerprint, check_spec
from manip_il.doctor.pictures import check_pictures
from manip_il.doctor.recorder import check_recorder
from manip_il.doctor.rows import check_columns, check_rows, check_task_numbers
from manip_il.doctor.values import check_finite, check_statistics
from manip_il.doctor.videos import check_videos

Check = Callable[[Dataset], Iterator[Finding]]

CHECKS: tuple[Check, ...] = (
    check_info,
    check_recorder,
    check_footers,
    check_episodes,
    check_tasks,
    check_columns,
    check_rows,
    check_task_numbers,
    check_finite,
    check_statistics,
    check_videos,
    check_pictures,
    check_spec,
    check_fingerprint,
    check_stale_files,
    check_leftovers,
    check_journals,
)


def examine(dataset: Dataset, checks: Sequence[Check] = CHECKS) -> Iterator[Finding]:
    """Yield every finding, as it is found; none for a dataset that is whole.

    Raises nothing, whatever the folder holds.
    """
    for check in checks:
        try:
            yield from check(dataset)
        except Exception as problem:  # one check that fails must not hide the others
            what = check.__name__.replace("_", " ")
            text = f"{what} could not be finished: {type(problem).__name__}: {problem}"
            yield error(str(dataset.root), text, Remedy.NONE)


def verdict(dataset: Dataset, findings: Sequence[Finding]) -> str:
    """Return one line: what is there and whole, or how much is wrong."""
    counts = count_text(findings)
    if has_errors(findings) or dataset.info is None:
        return f"{dataset.root}: {counts}"
    whole = count_frames(dataset.info.episodes, dataset.info.frames)
    return f"{dataset.root}: {whole}: whole{f', {counts}' if counts else ''}"


def has_errors(findings: Sequence[Finding]) -> bool:
    """Return whether anything is wrong."""
    return any(finding.severity is Severity.ERROR for finding in findings)


def examine_folder(root: Path) -> list[Finding]:
    """Return all findings about a folder."""
    return list(examine(Dataset(root)))
