"""Progress and Ctrl-C for work that goes through stages: collect, fit, validate, and again."""

from __future__ import annotations

import contextlib
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol

from manip_il.cli.interrupt import Interrupted, StopRequest
from manip_il.cli.progress import Progress, progress
from manip_il.errors import ManipError, UsageError

if TYPE_CHECKING:
    from manip_il.algorithms.run import Watch


class Ended(Protocol):
    """An episode that has ended, or its result."""

    @property
    def success(self) -> bool:
        """At some time."""
        ...


class Stages:
    """One progress bar at a time; use as a context manager. A stop request is honoured at every report.

    kept: what to tell the user is safe on disk, also where the work fails.
    """

    def __init__(self, kept: str):
        self.kept = kept
        self._stop = StopRequest()
        self._open = contextlib.ExitStack()
        self._bar: Progress | None = None
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
        self._bar = None

    def episode(self, episode: Ended) -> None:
        """One more episode has ended."""
        self._done += 1
        self._solved += episode.success
        if self._bar is not None:
            self._bar.advance(success=self._solved / self._done)
        self.check()

    def step(self) -> None:
        """One more of whatever is counted is done."""
        if self._bar is not None:
            self._bar.advance()
        self.check()

    def log(self, record: dict[str, Any]) -> None:
        """A fit's metrics at a step; {} where there are none."""
        if not record:
            self.check()
            return
        if self._bar is not None:
            self._bar.advance(record["step"] - self._done, loss=record["loss"])
        self._done = record["step"]
        self.check()

    def check(self) -> None:
        """Raise `Interrupted` where the user has asked to stop."""
        if self._stop.requested:
            raise Interrupted(self.kept)

    def watch(self) -> Watch:
        """What a run reports to."""
        from manip_il.algorithms.run import Watch

        return Watch(
            on_stage=lambda stage, round_, total: self.start(f"round {round_}, {stage}", total),
            on_episode=self.episode,
            on_log=self.log,
        )
