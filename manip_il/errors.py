"""Errors that explain themselves: the thing, its value, what was expected, what to do next.

The command line turns every `ManipError` into one line on standard error and its `exit_code`.
"""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable, Sequence

_FEW = 3  # names that an error offers
_BEGINNING = 3  # characters of a name that tell it from others
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
        """Pickle by the message: subclasses build theirs from other arguments, and a worker's error must come home."""
        return ManipError.__new__, (type(self), str(self))


class UsageError(ManipError):
    """The command line was invalid: an unknown name, option or value (exit code 2)."""

    exit_code = 2


class UnknownName(UsageError):
    """A name that is not in a table of names; says which names are, and the nearest."""

    def __init__(self, kind: str, name: str, known: Iterable[str], where: str = ""):
        """Take the table's names, and for a long table what lists them; then the nearest few are named alone."""
        known = sorted(known)
        near = did_you_mean(nearest_names(name, known, most=_FEW if where else 1))
        super().__init__(f"unknown {kind} {shorten(name)}{near}; {where or f'known: {", ".join(known)}'}")


class MismatchError(ManipError):
    """Two sides that must agree (dataset, policy, environment) do not; names both."""

    def __init__(self, what: str, left: str, left_value: object, right: str, right_value: object):
        super().__init__(f"{what} differs: {left} has {left_value}, {right} has {right_value}")


class OlderSchemaError(ManipError):
    """Data of another version of our columns, which cannot be read as today's; says how to make them again."""

    def __init__(self, found: str, reads: int):
        super().__init__(
            f"written with schema {found} of manip_il's columns, and this version reads {reads}; make it again, into "
            "another folder: manip-il record, train or dagger with the same options"
        )


class NotFiniteError(ManipError):
    """NaN or infinity where a number was needed."""


class NothingToLearnError(ManipError):
    """Rollouts that leave no label behind."""


class FolderExistsError(UsageError):
    """An output folder that holds something already."""

    def __init__(self, folder: object):
        ways = "--resume=true goes on where a command can, --overwrite=true replaces it"
        super().__init__(f"{folder} exists already; {ways}; or choose another folder")


class RenderError(ManipError):
    """No working OpenGL for off-screen pictures."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ` (did you mean 'x'?)`, or nothing where no known name is near."""
    return did_you_mean(nearest_names(name, known, most=1))


def nearest_names(name: str, known: Iterable[str], most: int = _FEW) -> list[str]:
    """Return the known names that `name` may stand for, at most `most`: those that it begins, then the most alike."""
    known = list(known)
    begun = [one for one in known if len(name) >= _BEGINNING and one.startswith(name)]
    alike = difflib.get_close_matches(name, known, n=most, cutoff=0.6 if len(name) > _BEGINNING else 0.5)
    return list(dict.fromkeys([*begun, *alike]))[:most]


def did_you_mean(names: Sequence[str]) -> str:
    """Return ` (did you mean 'x', 'y' or 'z'?)`, or nothing without names."""
    *others, last = map(repr, names) if names else ("",)
    return f" (did you mean {', '.join(others)}{' or ' if others else ''}{last}?)" if last else ""


def printable(text: str) -> str:
    """Return a text with its control characters escaped, as a terminal obeys them; line breaks and tabs stay."""
    return "".join(one if one.isprintable() or one in "\n\t" else repr(one)[1:-1] for one in text)


def shorten(value: object) -> str:
    """Return `repr(value)` in at most 300 characters, whatever the value is."""
    printed = _PRINTED.repr(value)
    return printed if len(printed) <= _LONGEST_PRINTED else f"{printed[: _LONGEST_PRINTED - 3]}..."


def silence_ffmpeg_warning() -> None:
    """Hide LeRobot's page of warning of missing FFmpeg libraries: pictures are read with PyAV, which has its own."""
    import logging  # here, as help needs none

    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
