"""What the doctor reports: one line a finding, with what is wrong, where, how much of it, and what to do."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from manip_il.data.lerobot_layout import INFO, STATS
from manip_il.errors import ManipError


@dataclass(frozen=True)
class Finding:
    """One line of a report: an error is wrong data, or such that LeRobot cannot train on; else it is worth knowing.

    place: a file in the dataset or beside it, or a column. remedy: what to do; an examination fills in `mend`.
    """

    place: str
    text: str
    remedy: str = ""
    is_error: bool = True

    def __str__(self) -> str:
        line = f"{'error' if self.is_error else 'warning':7}  {self.place}: {self.text}; {self.remedy}"
        # names and texts come from the dataset: no control characters reach the terminal
        return "".join(character if character.isprintable() else " " for character in line)


warning = partial(Finding, is_error=False)


class NotWhole(ManipError):
    """The examined dataset has errors; the message is the verdict."""


def journals_of(root: Path) -> Path:
    """Return the folder of a dataset's journals, beside it; it may be missing."""
    return root.absolute().with_name(f"{root.absolute().name}.journals")


def mend(root: Path, finding: Finding) -> str:
    """Return the remedy of what a dataset's journals give back, or its own data correct."""
    if journals_of(root).is_dir() or not finding.is_error or finding.place.startswith((INFO, STATS)):
        return f"repair it: manip-il data repair {root}"
    return "without journals beside it: pull or record it again"


def of_episodes(root: Path, place: str, text: str, episodes: Collection[int]) -> Finding:
    """Return a warning of what is wrong with some episodes for good."""
    numbers = f'--new_root={root}_kept --operation.episode_indices="[{", ".join(map(str, episodes))}]"'
    remedy = f"record these again, or leave them out: {edit(root, 'delete_episodes')} {numbers}"
    return warning(place, f"{text} (episodes {list_first(episodes)})", remedy)


def edit(root: Path, operation: str) -> str:
    """Return the command of LeRobot's tool for an operation."""
    return f"lerobot-edit-dataset --repo_id=local/{root.absolute().name} --root={root} --operation.type={operation}"


def list_first(values: Collection[object]) -> str:
    """List the first three values, and count the rest: `3, 7, 9 and 2 more`."""
    texts = [str(value) for value in values]
    return ", ".join(texts[:3]) + (f" and {len(texts) - 3:,} more" if len(texts) > 3 else "")
