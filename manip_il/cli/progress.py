"""Output of commands: lines, warnings, and progress (a bar on a terminal, else a line every 5
seconds).
"""

from __future__ import annotations

import logging
import os
import shlex
import signal
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any, TextIO, override

from tqdm import tqdm

from manip_il.errors import ManipError, UsageError, printable
from manip_il.progress import Progress

_STOPPING = b"\nstopping after the current step (press Ctrl-C again to stop at once)\n"

_quiet = False


def set_quiet(quiet: bool) -> None:
    """Switch progress off or on for this process; `say` is not affected."""
    global _quiet
    _quiet = quiet


def has_bars() -> bool:
    """Return whether to show bars: on a terminal, unless progress is switched off."""
    return sys.stderr.isatty() and not _quiet


def say(*lines: str) -> None:
    """Print lines on standard output."""
    for line in lines:
        _print(printable(line), sys.stdout)


def say_next(*words: object, what: str = "next", program: str = "manip-il") -> None:
    """Print a command to copy, quoted for a shell.

    Args:
        words: The words after the program's name.
        what: What the command is for.
        program: The program's name.
    """
    say(f"{what}: {shlex.join([program, *map(str, words)])}")


def warn(*lines: str) -> None:
    """Print warnings on standard error, one line each."""
    for line in lines:
        _print(f"manip-il: warning: {printable(' '.join(line.split()))}", sys.stderr)


class Warnings(logging.Handler):
    """Prints what is logged as a warning."""

    @override
    def emit(self, record: logging.LogRecord) -> None:
        warn(record.getMessage())


def _print(line: str, file: TextIO) -> None:
    tqdm.write(line, file)  # above a bar, if there is one
    file.flush()


class _Log:
    """The file of a bar that is not on a terminal: every update is a line on standard error."""

    def write(self, text: str) -> None:
        if line := text.strip():
            print(line.replace("( ", "("), file=sys.stderr)  # tqdm pads rates

    def flush(self) -> None:
        sys.stderr.flush()


_PLAIN: dict[str, Any] = {
    "file": _Log(),
    "mininterval": 5.0,  # [s]
    "miniters": 1,
    "delay": 1.0,
    "unit": "",
    "bar_format": "{desc}: {n_fmt}/{total_fmt} ({rate_noinv_fmt}{postfix})",
}


class Stages(Progress):
    """Progress of work in stages, each a number of steps; use as a context manager.

    Shows a bar on a terminal, else lines like `record: 12/50 (3.40/s, success=0.92)`; nothing if
    progress is switched off. The first Ctrl-C or SIGTERM stops the work after the current step, the
    second at once.

    Args:
        kept: What is saved and can be resumed, for the message if the work is interrupted or fails.
        prepare: Prepares the output when the inputs have been checked.
    """

    def __init__(self, kept: str = "", prepare: Callable[[], None] | None = None):
        self.kept = kept
        self._prepare = prepare
        self._has_output = prepare is None
        self._stopping = False
        self._handlers = dict[int, Any]()
        self._bar: Any = None
        self._solved = 0

    def __enter__(self) -> Stages:
        self._handlers = {
            number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if not self._has_output or not self.kept or isinstance(error, UsageError):
            return
        if isinstance(error, ManipError | KeyboardInterrupt):
            prefix = f"{error}; " if error.args else ""
            error.args = (f"{prefix}kept: {self.kept}; continue with --resume=true",)

    def _stop(self, *_: object) -> None:
        if self._stopping:
            raise KeyboardInterrupt
        self._stopping = True
        os.write(2, _STOPPING)  # print() is not reentrant, and a signal can interrupt one

    @override
    def started(self) -> None:
        if self._prepare is not None:
            self._prepare()
            self._has_output = True

    @override
    def start(self, description: str, total: int | None) -> None:
        self.close()
        self.check()
        how: dict[str, Any] = {"dynamic_ncols": True} if sys.stderr.isatty() else _PLAIN
        self._bar = tqdm(total=total, desc=description, disable=_quiet or total == 0, **how)
        self._bar.delay = 0.0  # the delay only keeps the constructor from writing a line
        self._solved = 0

    @override
    def close(self) -> None:
        if self._bar is not None:
            self._bar.leave = self._bar.n > 0
            self._bar.close()
            self._bar = None

    @override
    def step(self, n: int = 1, **numbers: float) -> None:
        """Count some steps of the stage.

        Args:
            n: Number of steps.
            numbers: Shown beside the bar, such as loss=0.12, until they are replaced.
        """
        if self._bar is not None:
            if numbers:
                self._bar.set_postfix(numbers, refresh=False)
            self._bar.update(n)
        self.check()

    @override
    def episode(self, episode: Any) -> None:
        self._solved += episode.success
        self.step(success=self._solved / (self._bar.n + 1) if self._bar is not None else 0.0)

    @override
    def log(self, record: dict[str, Any]) -> None:
        if record and self._bar is not None:
            shown = {name: record[name] for name in ("loss", "success", "kl") if name in record}
            self.step(record["step"] - self._bar.n, **shown)
        self.check()

    @override
    def finished(self, result: Any) -> None:
        self.close()
        learnt = f"{result.labels:,} labels, validation success {result.validation.success}"
        say(f"{result.unit} {result.number}: {learnt}, {sum(result.seconds.values()):.0f} s")
        self.check()

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if the user has asked to stop."""
        if self._stopping:
            raise KeyboardInterrupt


@contextmanager
def progress(total: int | None, description: str) -> Generator[Stages]:
    """Yield the progress of a single stage, see `Stages.start`."""
    with Stages() as stages:
        stages.start(description, total)
        yield stages
