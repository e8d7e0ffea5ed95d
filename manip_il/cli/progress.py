"""Output of commands: lines, warnings, and progress (a bar on a terminal, else a line every few seconds)."""

from __future__ import annotations

import sys
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from manip_il.cli.interrupt import Interrupted, StopRequest
from manip_il.errors import ManipError, UsageError, printable

if TYPE_CHECKING:
    from manip_il.algorithms.run import Watch
    from manip_il.evaluation.results import EpisodeResult, EvalResult
    from manip_il.mdp import Episode

INTERVAL = 5.0  # [s] between plain lines

_quiet = False


class Progress:
    """Display of work under way; of this class itself, none."""

    def advance(self, n: int = 1, **fields: object) -> None:
        """Add `n` steps; `fields` (loss=0.12, success=0.9) replace those displayed so far."""


def set_quiet(quiet: bool) -> None:
    """Switch progress off (or on again) for this process; `say` is not affected."""
    global _quiet
    _quiet = quiet


def is_quiet() -> bool:
    """Return whether progress is switched off."""
    return _quiet


def say(line: str) -> None:
    """Print a line of normal output, on standard output."""
    print(printable(line), flush=True)


def say_policy(policy: Path, validation: EvalResult, test: str, remedies: str) -> None:
    """Print where a run's best policy is and how to test it, or, if it never succeeded, what to try.

    test: the command that tests it. remedies: what may help.
    """
    from manip_il.evaluation.failures import evaluation_verdict

    if validation.success.successes:
        say(f"best policy: {policy}")
        say(f"next: {test}")
        return
    say(evaluation_verdict(validation))
    say(f"try in a new run: {remedies}")
    say(f"failures by phase, with films: {test}")


def warn(*lines: str) -> None:
    """Print warnings on standard error, one line each."""
    for line in lines:
        print(f"manip-il: warning: {printable(' '.join(line.split()))}", file=sys.stderr, flush=True)


@contextmanager
def progress(total: int | None, description: str) -> Generator[Progress]:
    """Show the progress of `total` steps (None if the number is unknown) while the `with` lasts."""
    if _quiet:
        yield Progress()
    elif sys.stderr.isatty():
        with _bar(total, description) as bar:
            yield bar
    else:
        lines = _Lines(total, description)
        try:
            yield lines
        finally:
            lines.finish()


class _Lines(Progress):
    """Lines at most every `INTERVAL`, and one at the end: `record: 12/50 (3.4/s, success 0.92)`."""

    def __init__(self, total: int | None, description: str):
        self._total, self._description = total, description
        self._done = 0
        self._fields: dict[str, object] = {}
        self._start = self._printed = time.monotonic()
        self._fresh = True  # advanced since the last line

    def advance(self, n: int = 1, **fields: object) -> None:
        self._done += n
        self._fields |= fields
        self._fresh = True
        now = time.monotonic()
        if now - self._printed >= INTERVAL:
            self._print(now)

    def finish(self) -> None:
        if self._fresh:
            self._print(time.monotonic())

    def _print(self, now: float) -> None:
        self._printed, self._fresh = now, False
        count = "/".join(str(number) for number in (self._done, self._total) if number is not None)
        rate = self._done / max(now - self._start, 1e-9)
        details = ", ".join(filter(None, [f"{rate:.3g}/s", _fields_text(self._fields)]))
        print(f"{self._description}: {count} ({details})", file=sys.stderr, flush=True)


class _Bar(Progress):
    def __init__(self, bar: Any, task: Any):
        self._bar, self._task = bar, task
        self._fields: dict[str, object] = {}

    def advance(self, n: int = 1, **fields: object) -> None:
        self._fields |= fields
        self._bar.update(self._task, advance=n, details=_fields_text(self._fields))


@contextmanager
def _bar(total: int | None, description: str) -> Generator[_Bar]:
    from rich import progress as rich_progress
    from rich.console import Console

    columns = (
        rich_progress.TextColumn("{task.description}", markup=False),
        rich_progress.BarColumn(),
        rich_progress.MofNCompleteColumn(),
        rich_progress.TimeRemainingColumn(),
        rich_progress.TextColumn("{task.fields[details]}", markup=False),
    )
    # Redirected output would go to standard error with the bar, and be lost to `manip-il ... > file`.
    with rich_progress.Progress(*columns, console=Console(stderr=True), redirect_stdout=sys.stdout.isatty()) as bar:
        yield _Bar(bar, bar.add_task(description, total=total, details=""))


def _fields_text(fields: dict[str, object]) -> str:
    return ", ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in fields.items()
    )


class Stages:
    """One progress bar at a time; use as a context manager. A stop request takes effect at the next step.

    kept: what is safe on disk, for the message to the user, also if the work fails.
    """

    def __init__(self, kept: str):
        self.kept = kept
        self._stop = StopRequest()
        self._open = ExitStack()
        self._bar = Progress()
        self._done = self._solved = 0

    def __enter__(self) -> Stages:
        self._stop.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        self._stop.__exit__(kind, error, trace)
        if isinstance(error, ManipError) and not isinstance(error, UsageError):
            error.args = (f"{error}; kept: {self.kept}; continue with --resume=true",)

    def start(self, description: str, total: int) -> None:
        """Close the bar of the stage before and open one of `total` episodes or steps."""
        self.close()
        self.check()
        self._done = self._solved = 0
        self._bar = self._open.enter_context(progress(total, description))

    def close(self) -> None:
        """Close the bar."""
        self._open.close()
        self._bar = Progress()

    def episode(self, episode: Episode | EpisodeResult) -> None:
        """Count an episode that has ended."""
        self._done += 1
        self._solved += episode.success
        self._bar.advance(success=self._solved / self._done)
        self.check()

    def step(self) -> None:
        """Count a step that is done."""
        self._bar.advance()
        self.check()

    def reach(self, step: int, **fields: object) -> None:
        """Show that a stage has reached a step, and what `fields` say of it."""
        self._bar.advance(step - self._done, **fields)
        self._done = step
        self.check()

    def log(self, record: dict[str, Any]) -> None:
        """Show a fit's metrics at a step; {} if there are none."""
        if record:
            self._bar.advance(record["step"] - self._done, loss=record["loss"])
            self._done = record["step"]
        self.check()

    def check(self) -> None:
        """Raise `Interrupted` if the user has asked to stop."""
        if self._stop.requested:
            raise Interrupted(self.kept)

    def watch(self) -> Watch:
        """Return the callbacks that a run of an algorithm reports to."""
        from manip_il.algorithms.run import Watch

        return Watch(
            on_stage=lambda stage, round_, total: self.start(f"round {round_}, {stage}", total),
            on_episode=self.episode,
            on_log=self.log,
            on_step=self.step,
        )
