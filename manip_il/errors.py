"""Error types, whose messages name the thing, its value, what was expected and what to do next.

The command line prints a `ManipError` as one line on standard error and exits with its `exit_code`.
"""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable, Sequence

_MOST_OFFERED = 3  # names that an error suggests
_SHORTEST_PREFIX = 3  # [characters]; shorter ones match too many names
_LONGEST_PRINTED = 300  # [characters]
_PRINTED = reprlib.Repr()
_PRINTED.maxstring = _PRINTED.maxother = _PRINTED.maxlong = 80
_PRINTED.maxlevel = 2
_PRINTED.maxlist = _PRINTED.maxtuple = _PRINTED.maxdict = _PRINTED.maxset = 4


class ManipError(Exception):
    """The work failed (exit code 1)."""

    exit_code = 1

    def __str__(self) -> str:
        return printable(super().__str__())

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the message: subclasses have other arguments, and a worker's errors must reach the main process."""
        return ManipError.__new__, (type(self), str(self))


class UsageError(ManipError):
    """The command line is invalid: an unknown name, option or value (exit code 2)."""

    exit_code = 2


class UnknownName(UsageError):
    """A name is unknown; the message lists the known names and the nearest."""

    def __init__(self, kind: str, name: str, known: Iterable[str], where: str = ""):
        """Take the known names. where: what lists them, if they are many; then only the nearest are named."""
        known = sorted(known)
        near = did_you_mean(nearest_names(name, known, most=_MOST_OFFERED if where else 1))
        super().__init__(f"unknown {kind} {shorten(name)}{near}; {where or f'known: {", ".join(known)}'}")


class MismatchError(ManipError):
    """Two things that must agree (dataset, policy, environment) differ; the message names both."""

    def __init__(self, what: str, left: str, left_value: object, right: str, right_value: object):
        super().__init__(f"{what} differs: {left} has {left_value}, {right} has {right_value}")


class OlderSchemaError(ManipError):
    """The data have an older version of our columns, which cannot be read; the message says how to make them again."""

    def __init__(self, found: str, reads: int):
        super().__init__(
            f"written with schema {found} of manip_il's columns, but this version reads {reads}; make it again in "
            "another folder: manip-il record, train or dagger with the same options"
        )


class NotFiniteError(ManipError):
    """A value is NaN or infinite."""


class NothingToLearnError(ManipError):
    """The rollouts produced no label."""


class FolderExistsError(UsageError):
    """An output folder is not empty."""

    def __init__(self, folder: object):
        ways = "--resume=true continues it, if the command can, --overwrite=true replaces it"
        super().__init__(f"{folder} already exists; {ways}; or choose another folder")


class RenderError(ManipError):
    """OpenGL for off-screen rendering does not work."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ` (did you mean 'x'?)`, or "" if no known name is near."""
    return did_you_mean(nearest_names(name, known, most=1))


def nearest_names(name: str, known: Iterable[str], most: int = _MOST_OFFERED) -> list[str]:
    """Return at most `most` known names like `name`: those that begin with it, then the most similar."""
    known = list(known)
    longer = [one for one in known if len(name) >= _SHORTEST_PREFIX and one.startswith(name)]
    similar = difflib.get_close_matches(name, known, n=most, cutoff=0.6 if len(name) > _SHORTEST_PREFIX else 0.5)
    return list(dict.fromkeys([*longer, *similar]))[:most]


def did_you_mean(names: Sequence[str]) -> str:
    """Return ` (did you mean 'x', 'y' or 'z'?)`, or "" without names."""
    *others, last = map(repr, names) if names else ("",)
    return f" (did you mean {', '.join(others)}{' or ' if others else ''}{last}?)" if last else ""


def printable(text: str) -> str:
    """Escape control characters, which a terminal would obey, except line breaks and tabs."""
    return "".join(one if one.isprintable() or one in "\n\t" else repr(one)[1:-1] for one in text)


def shorten(value: object) -> str:
    """Return `repr(value)`, shortened to at most 300 characters."""
    printed = _PRINTED.repr(value)
    return printed if len(printed) <= _LONGEST_PRINTED else f"{printed[: _LONGEST_PRINTED - 3]}..."


def silence_ffmpeg_warning() -> None:
    """Hide LeRobot's long warning about missing FFmpeg libraries: we read video with PyAV, which has its own."""
    import logging  # imported here because help needs none

    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
