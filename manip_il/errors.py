"""Error types, whose messages name the thing, its value, what was expected and what to do next.

The command line prints a `ManipError` as one line on standard error and exits with its `exit_code`.
"""

import difflib
import logging
import reprlib
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

OWN = "manip_il_own_"  # prefix of the names of modules that are loaded from users' own files
_LONGEST_PRINTED = 200  # [characters]
_REPR = reprlib.Repr(
    maxstring=_LONGEST_PRINTED, maxlong=_LONGEST_PRINTED, maxother=_LONGEST_PRINTED
)


class ManipError(Exception):
    """The work failed (exit code 1)."""

    exit_code = 1

    def __str__(self) -> str:
        return printable(super().__str__())

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the message: subclasses have other arguments, and a worker's errors must reach
        the main process.
        """
        return ManipError.__new__, (type(self), str(self))


class UsageError(ManipError):
    """The command line is invalid: an unknown name, option or value (exit code 2)."""

    exit_code = 2


class UnknownName(UsageError):
    """A name is unknown; the message lists the known names and the nearest.

    Args:
        kind: What is named, such as `task`.
        name: The unknown name.
        known: All names that would have been accepted.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str]):
        known = sorted(known)
        super().__init__(
            f"unknown {kind} {shorten(name)}{nearest(name, known)}; known: {', '.join(known)}"
        )


class MismatchError(ManipError):
    """Two things that must agree (dataset, policy, environment) differ; the message names both.

    Args:
        what: The property in which they differ.
        left: The name of one thing.
        left_value: Its value of the property.
        right: The name of the other thing.
        right_value: The other thing's value of the property.
    """

    def __init__(self, what: str, left: str, left_value: object, right: str, right_value: object):
        super().__init__(f"{what} differs: {left} has {left_value}, {right} has {right_value}")


class NotFiniteError(ManipError):
    """A value is NaN or infinite."""


class NothingToLearnError(ManipError):
    """The rollouts produced no label."""


class FolderExistsError(UsageError):
    """An output folder already exists.

    Args:
        folder: The folder, for the message.
    """

    def __init__(self, folder: object):
        super().__init__(
            f"{folder} already exists; --resume=true continues it, if the command has that option;"
            " --overwrite=true replaces it; or choose another folder"
        )


class RenderError(ManipError):
    """OpenGL for off-screen rendering does not work."""


@contextmanager
def requires(what: str, install: str) -> Iterator[None]:
    """Import packages that not every installation has.

    Args:
        what: What needs them, for the message.
        install: The words that follow `pip install`.

    Raises:
        ManipError: If a package is missing; the message says how to install it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ManipError(
            f"{what} needs {error.name}, which is not installed: pip install {install}"
        ) from error


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint at the known name that is most like a name.

    Args:
        name: The unknown name.
        known: The known names.

    Returns:
        ` (did you mean 'x'?)`, or "" if no known name is near.
    """
    near = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def printable(text: str) -> str:
    """Escape control characters except line breaks and tabs, so that a terminal does not obey
    them.
    """
    return "".join(one if one.isprintable() or one in "\n\t" else repr(one)[1:-1] for one in text)


def told(error: BaseException) -> str:
    """Return an unexpected error as text, with file, line and function if a user's own file
    raised it.
    """
    frames = [
        one
        for one in traceback.walk_tb(error.__traceback__)
        if one[0].f_globals["__name__"].startswith(OWN)
    ]
    text = f"{type(error).__name__}: {error}"
    if not frames:
        return text
    frame, line = frames[-1]
    return f"{frame.f_code.co_filename}, line {line} ({frame.f_code.co_name}): {text}"


def shorten(value: object) -> str:
    """Return `repr(value)`, cut to at most 200 characters.

    A large structure is shown by its first values.
    """
    printed = _REPR.repr(value)
    return printed if len(printed) <= _LONGEST_PRINTED else f"{printed[: _LONGEST_PRINTED - 3]}..."


def warn(*lines: str) -> None:
    """Log warnings, one line each, which the command line prints on standard error."""
    for line in lines:
        logging.getLogger("manip_il").warning("%s", printable(line))


def silence_ffmpeg_warning() -> None:
    """Hide LeRobot's long warning about missing FFmpeg libraries: we read video with PyAV, which
    has its own.
    """
    logging.getLogger("lerobot.utils.import_utils").setLevel(logging.ERROR)
