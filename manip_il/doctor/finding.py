"""Findings: what the doctor reports, one line each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from manip_il.errors import ManipError


class Severity(Enum):
    """An error is something that is wrong; a warning is something to know."""

    ERROR = "error"
    WARNING = "warning"


class Remedy(Enum):
    """Means by which `repair` may correct a finding."""

    NONE = "none"
    MOVE = "move"  # the file or folder at `place` is moved to the kept copy
    STATISTICS = "statistics"  # computed again from the data
    REBUILD = "rebuild"  # the whole dataset is built again from its journals


@dataclass(frozen=True)
class Finding:
    """One line of a report. place: a file in the dataset, `FILE: column`, or a path beside the dataset."""

    severity: Severity
    place: str
    text: str
    remedy: Remedy = Remedy.NONE

    def __str__(self) -> str:
        line = f"{self.severity.value:7}  {self.place}: {self.text}"
        # names and texts come from the dataset: no control characters reach the terminal
        return "".join(character if character.isprintable() else " " for character in line)


class NotWhole(ManipError):
    """The examined dataset has errors; the message is the verdict."""


def error(place: str, text: str, remedy: Remedy = Remedy.REBUILD) -> Finding:
    """Return an error, by default one that a rebuild from journals corrects."""
    return Finding(Severity.ERROR, place, text, remedy)


def warning(place: str, text: str, remedy: Remedy = Remedy.NONE) -> Finding:
    """Return a warning."""
    return Finding(Severity.WARNING, place, text, remedy)


def plural(count: int, name: str) -> str:
    """Return a count with its noun: `1 frame`, `1,200 frames`."""
    return f"{count:,} {name}{'' if count == 1 else 's'}"


def count_frames(episodes: int, frames: int) -> str:
    """Return both counts as text: `12 episodes, 246 frames`."""
    return f"{plural(episodes, 'episode')}, {plural(frames, 'frame')}"


def list_first(values: Iterable[object]) -> str:
    """List the first three values, and count the rest: `3, 7, 9 and 2 more`."""
    texts = [str(value) for value in values]
    rest = f" and {len(texts) - 3:,} more" if len(texts) > 3 else ""
    return ", ".join(texts[:3]) + rest
