"""Run `manip-il data check`, `repair`: find errors in a dataset, and repair them."""

from __future__ import annotations

from collections.abc import Iterator

from manip_il.bridges.doctor.examine import examine_folder, repair
from manip_il.bridges.doctor.files import Finding, warning
from manip_il.cli.data_check import CheckOptions, RepairOptions
from manip_il.cli.progress import say
from manip_il.collect.inputs import differences
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import OURS
from manip_il.errors import ManipError


def run_check(options: CheckOptions) -> None:
    """Check the dataset and print every finding and the verdict; raises `ManipError` if there are errors."""
    _conclude(options, _examine(options), f"try manip-il data repair {options.dataset}")


def _examine(options: CheckOptions) -> list[Finding]:
    """Check the dataset and print every finding."""
    findings = examine_folder(options.dataset.absolute(), [check_robot])
    say(*map(str, findings))
    return findings


def _conclude(options: CheckOptions, findings: list[Finding], remedy: str) -> None:
    errors = sum(finding.is_error for finding in findings)
    if errors:
        raise ManipError(f"{options.dataset}: errors: {errors}, warnings: {len(findings) - errors}; {remedy}")
    info = Dataset.open(options.dataset).info
    say(f"{options.dataset}: {info.episodes:,} episodes, {info.frames:,} frames: whole; warnings: {len(findings)}")


def run_repair(options: RepairOptions) -> None:
    """Check, repair, check again, and print the verdict; raises `ManipError` if errors remain."""
    if findings := _examine(options):
        say(*(f"repair   {line}" for line in repair(options.dataset.absolute(), findings)))
        findings = _examine(options)
    _conclude(options, findings, "these cannot be repaired from what is here: pull or record it again")


def check_robot(dataset: Dataset) -> Iterator[Finding]:
    """Compare a dataset's joints, observations and model with those of its robot and task in this version."""
    if dataset.own is None:
        return
    try:
        for text in differences(dataset):
            yield warning(OURS, text, f"for labels of the current expert: manip-il data relabel {dataset.root}")
    except ManipError as error:
        yield Finding(OURS, str(error), "use the version of this program that recorded it, or record again")
