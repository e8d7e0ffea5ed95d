"""Output of commands: lines, warnings, and progress (a bar on a terminal, else a line every 5 seconds)."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any

from manip_il.errors import ManipError, UsageError, printable

if TYPE_CHECKING:
    from manip_il.algorithms.results import Watch
    from manip_il.evaluation.results import EpisodeResult
    from manip_il.mdp import Episode

INTERVAL = 5.0  # [s] between plain lines
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
        print(printable(line), flush=True)


def warn(*lines: str) -> None:
    """Print warnings on standard error, one line each."""
    for line in lines:
        print(f"manip-il: warning: {printable(' '.join(line.split()))}", file=sys.stderr, flush=True)


class Stages:
    """Progress of work in stages, each a number of steps; use as a context manager.

    Shows a bar on a terminal, else lines like `record: 12/50 (3.4/s, success 0.92)`; nothing if progress is switched
    off. The first Ctrl-C or SIGTERM stops the work after the current step, the second at once. kept: what is saved and
    can be resumed, for the message if the work is interrupted or fails.
    """

    def __init__(self, kept: str = ""):
        self.kept, self._stopping, self._handlers = kept, False, dict[int, Any]()
        self._bar: Any = None
        self._fields: dict[str, object] = {}
        self._began = self._printed = 0.0
        self._solved = 0

    def __enter__(self) -> Stages:
        self._handlers = {number: signal.signal(number, self._stop) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self.kept and isinstance(error, ManipError | KeyboardInterrupt) and not isinstance(error, UsageError):
            prefix = f"{error}; " if error.args else ""
            error.args = (f"{prefix}kept: {self.kept}; continue with --resume=true",)

    def _stop(self, *_: object) -> None:
        if self._stopping:
            raise KeyboardInterrupt
        self._stopping = True
        os.write(2, _STOPPING)  # print() is not reentrant, and a signal can interrupt one

    def start(self, description: str, total: int | None) -> None:
        """Close the previous stage's bar and open a new one. total: number of steps, None if unknown."""
        from rich import progress
        from rich.console import Console

        self.close()
        self.check()
        columns = (
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeRemainingColumn(),
            progress.TextColumn("{task.fields[details]}", markup=False),
        )
        # Redirection would send output to standard error with the bar, and `manip-il ... > file` would lose it.
        redirect, hidden = sys.stdout.isatty(), total == 0 or not has_bars()
        self._bar = progress.Progress(*columns, console=Console(stderr=True), redirect_stdout=redirect, disable=hidden)
        self._bar.add_task(description, total=total, details="")
        self._bar.start()
        self._fields, self._solved = {}, 0
        self._began = self._printed = time.monotonic()

    def close(self) -> None:
        """Close the bar."""
        if self._bar is not None:
            self._bar.stop()
            if self._done:
                self._print()
            self._bar = None

    @property
    def _done(self) -> int:
        return int(self._bar.tasks[0].completed) if self._bar else 0

    def _print(self) -> None:
        self._printed = time.monotonic()
        if self._bar is not None and self._bar.disable and not _quiet:
            task, rate = self._bar.tasks[0], f"{self._done / max(self._printed - self._began, 1e-9):.3g}/s"
            count = self._done if task.total is None else f"{self._done}/{task.total:.0f}"
            details = ", ".join(filter(None, [rate, task.fields["details"]]))
            print(f"{task.description}: {count} ({details})", file=sys.stderr, flush=True)

    def step(self, n: int = 1, **fields: object) -> None:
        """Count `n` finished steps; `fields` (loss=0.12, success=0.9) update the displayed ones."""
        if self._bar is not None:
            self._fields |= fields
            texts = {name: f"{one:.4g}" if isinstance(one, float) else one for name, one in self._fields.items()}
            self._bar.update(0, advance=n, details=", ".join(f"{name} {text}" for name, text in texts.items()))
            if time.monotonic() - self._printed >= INTERVAL:
                self._print()
        self.check()

    def episode(self, episode: Episode | EpisodeResult) -> None:
        """Count a finished episode."""
        self._solved += episode.success
        self.step(success=self._solved / (self._done + 1))

    def log(self, record: dict[str, Any]) -> None:
        """Show that a fit or a run has reached a step, with its metrics. record: {} if there are none."""
        if record:
            shown = {name: record[name] for name in ("loss", "success", "kl") if name in record}
            self.step(record["step"] - self._done, **shown)
        self.check()

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if the user has asked to stop."""
        if self._stopping:
            raise KeyboardInterrupt

    def watch(self) -> Watch:
        """Return the callbacks for a run of an algorithm."""
        from manip_il.algorithms.results import Watch

        def start(stage: str, round_: int, total: int) -> None:
            self.start(f"round {round_}, {stage}", total)

        return Watch(start, self.episode, self.log, self.step)


@contextmanager
def progress(total: int | None, description: str) -> Generator[Stages]:
    """Yield the progress of a single stage, see `Stages.start`."""
    with Stages() as stages:
        stages.start(description, total)
        yield stages
