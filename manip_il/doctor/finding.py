"""What the doctor says: one finding a line."""

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
    """How `repair` may put it right."""

    NONE = "none"
    MOVE = "move"  # the file or folder at `place` goes into the kept copy
    STATISTICS = "statistics"  # computed again from the data
    REBUILD = "rebuild"  # the whole dataset is built again from its journals


@dataclass(frozen=True)
class Finding:
    """place: a file in the dataset, `FILE: column`, or a path beside it. text: what is wrong and what to do."""

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
    """Return something wrong, which a rebuild from journals cures unless said otherwise."""
    return Finding(Severity.ERROR, place, text, remedy)


def warning(place: str, text: str, remedy: Remedy = Remedy.NONE) -> Finding:
    """Return something to know."""
    return Finding(Severity.WARNING, place, text, remedy)


def count_text(findings: Iterable[Finding]) -> str:
    """`2 errors, 1 warning`; empty for none."""
    severities = [finding.severity for finding in findings]
    counts = {kind.value: severities.count(kind) for kind in Severity}
    return ", ".join(plural(count, name) for name, count in counts.items() if count)


def plural(count: int, name: str) -> str:
    """`1 frame`, `1,200 frames`."""
    return f"{count:,} {name}{'' if count == 1 else 's'}"


def count_frames(episodes: int, frames: int) -> str:
    """`12 episodes, 246 frames`."""
    return f"{plural(episodes, 'episode')}, {plural(frames, 'frame')}"


def some(values: Iterable[object], most: int = 3) -> str:
    """`3, 7, 9 and 2 more`."""
    texts = [str(value) for value in values]
    rest = f" and {len(texts) - most:,} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + rest
