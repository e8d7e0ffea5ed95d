"""Findings of a check, one line each: what is wrong, where, how much, and what to do."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import INFO, STATS
from manip_il.errors import ManipError


@dataclass(frozen=True)
class Finding:
    """One line of a report. Errors are wrong data, or data on which LeRobot cannot train; others are warnings.

    place: a file in the dataset or next to it, or a column. remedy: what to do; if empty, what `mend` returns.
    """

    place: str
    text: str
    remedy: str = ""
    is_error: bool = True

    def __str__(self) -> str:
        line = f"{'error' if self.is_error else 'warning':7}  {self.place}: {self.text}; {self.remedy}"
        # names and texts come from the dataset and may hold control characters
        return "".join(character if character.isprintable() else " " for character in line)


warning = partial(Finding, is_error=False)


class NotWhole(ManipError):
    """Raised if a dataset has errors; the message is the verdict."""


def journals_of(root: Path) -> Path:
    """Return the folder next to a dataset that holds its journals; it may not exist."""
    return root.absolute().with_name(f"{root.absolute().name}.journals")


def mend(root: Path, finding: Finding, *, repaired: bool = False) -> str:
    """Return what to do about a finding: repair the dataset if that is possible, else pull or record it again.

    repaired: whether it has just been repaired, so that this is what repair cannot do.
    """
    possible = journals_of(root).is_dir()
    if not finding.is_error or finding.place.startswith((INFO, STATS)):
        with suppress(ManipError):
            Dataset.open(root)
            possible = True
    if possible and not repaired:
        return f"repair it: manip-il data repair {root}"
    if possible or (root / INFO).exists():
        return "it cannot be repaired from what is here: pull or record it again"
    return f"give the folder of a dataset, in which {INFO} is"


def of_episodes(root: Path, place: str, text: str, episodes: Collection[int]) -> Finding:
    """Return a warning about episodes that cannot be repaired."""
    numbers = f'--new_root={root}_kept --operation.episode_indices="[{", ".join(map(str, episodes))}]"'
    remedy = f"record these again, or delete them: {edit(root, 'delete_episodes')} {numbers}"
    return warning(place, f"{text} (episodes {list_first(episodes)})", remedy)


def edit(root: Path, operation: str) -> str:
    """Return the command that runs an operation of LeRobot's dataset editor."""
    return f"lerobot-edit-dataset --repo_id=local/{root.absolute().name} --root={root} --operation.type={operation}"


def list_first(values: Collection[object]) -> str:
    """List the first three values and count the rest: `3, 7, 9 and 2 more`."""
    texts = [str(value) for value in values]
    return ", ".join(texts[:3]) + (f" and {len(texts) - 3:,} more" if len(texts) > 3 else "")
