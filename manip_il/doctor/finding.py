"""What the doctor reports: one line a finding, with what is wrong, where, how much of it, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path

from manip_il.errors import ManipError


class Severity(Enum):
    """An error is wrong data, or data that LeRobot cannot read or train on; a warning is something to know."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class Finding:
    """One line of a report. place: a file in the dataset or beside it, or a column. remedy: what to do."""

    place: str
    text: str
    remedy: str
    severity: Severity = Severity.ERROR

    def __str__(self) -> str:
        line = f"{self.severity.value:7}  {self.place}: {self.text}; {self.remedy}"
        # names and texts come from the dataset: no control characters reach the terminal
        return "".join(character if character.isprintable() else " " for character in line)


warning = partial(Finding, severity=Severity.WARNING)


class NotWhole(ManipError):
    """The examined dataset has errors; the message is the verdict."""


def journals_of(root: Path) -> Path:
    """Return the folder of a dataset's journals, beside it; it may be missing."""
    return root.absolute().with_name(f"{root.absolute().name}.journals")


def by_repair(root: Path) -> str:
    """Return the remedy of what a dataset's own data correct."""
    return f"repair it: manip-il data repair {root}"


def by_journals(root: Path) -> str:
    """Return the remedy of what journals alone give back."""
    return by_repair(root) if journals_of(root).is_dir() else "without journals beside it: pull or record it again"


def by_deletion(root: Path, episodes: Iterable[int]) -> str:
    """Return the remedy of what is wrong with some episodes for good."""
    numbers = f'--new_root={root}_kept --operation.episode_indices="[{", ".join(map(str, episodes))}]"'
    return f"record these again, or leave them out: {edit(root, 'delete_episodes')} {numbers}"


def edit(root: Path, operation: str) -> str:
    """Return the command of LeRobot's tool for an operation."""
    return f"lerobot-edit-dataset --repo_id=local/{root.absolute().name} --root={root} --operation.type={operation}"


def list_first(values: Iterable[object]) -> str:
    """List the first three values, and count the rest: `3, 7, 9 and 2 more`."""
    texts = [str(value) for value in values]
    return ", ".join(texts[:3]) + (f" and {len(texts) - 3:,} more" if len(texts) > 3 else "")
