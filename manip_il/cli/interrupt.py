"""Ctrl-C and SIGTERM: finish the current step, keep what is done, print how to resume."""

from __future__ import annotations

import os
import shlex
import signal
import threading
from collections.abc import Sequence
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_MESSAGE = b"\nstopping after the step in hand (Ctrl-C again to stop at once)\n"


class Interrupted(KeyboardInterrupt):
    """Raised if the user has stopped a command between two steps (exit code 130).

    kept: what is safe on disk, as in `12 of 50 episodes in datasets/x`. No `ManipError`, so that code which outlives
    errors (one failed episode, one failed round) does not outlive this.
    """

    def __init__(self, kept: str):
        super().__init__(kept)
        self.kept = kept


class StopRequest:
    """The first signal inside the `with` sets `requested`; the second raises `KeyboardInterrupt` at once.

    Outside the main thread, where Python gives no signals, it only ever reports False.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[signal.Signals, Any] = {}
        self._pid = os.getpid()

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._on_signal) for number in _SIGNALS}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._pid:  # a forked worker inherits the handlers: it ignores Ctrl-C, and dies of SIGTERM
            if number == signal.SIGTERM:
                signal.signal(number, signal.SIG_DFL)
                os.kill(os.getpid(), number)
        elif self.requested:
            raise KeyboardInterrupt
        else:
            self.requested = True
            os.write(2, _MESSAGE)  # print() may not be entered twice, and a signal can come inside one


def resume_command(words: Sequence[str], program: str = "manip-il") -> str:
    """Return the command line that was given, with `--resume=true` and without `--overwrite`."""
    kept: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word.partition("=")[0] not in ("--resume", "--overwrite"):
            kept.append(word)
        elif rest and rest[0] in ("true", "false") and "=" not in word:
            rest.pop(0)
    return shlex.join([program, *kept, "--resume=true"])
