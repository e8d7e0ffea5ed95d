"""A command that is killed and goes on, in a process of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.context import ForkServerProcess
from pathlib import Path

from manip_il.data.journal import list_episodes

from .child import living

PATIENCE = 600.0  # for a command that is not killed, and for the end of one that is [s]


@dataclass
class Command:
    """A command whose words name folders in `folder`; it is resumed where one of them, `kept`, holds something."""

    start: Callable[..., ForkServerProcess]
    words: tuple[str, ...]  # `{folder}` stands for the folder
    folder: Path
    kept: Path
    warm: bool = False

    def begin(self, *more: str) -> ForkServerProcess:
        self.folder.mkdir(exist_ok=True)
        if self.kept.is_dir() and any(self.kept.iterdir()) and not more:  # a kill may come before that
            more = ("--resume=true",)
        words = [word.format(folder=self.folder) for word in self.words]
        return self.start(*words, *more, log=self.folder / "log", warm=self.warm)

    def run(self, *more: str) -> float:
        """Seconds that it takes when nobody kills it."""
        started = time.monotonic()
        process = self.begin(*more)
        process.join(PATIENCE)
        assert process.exitcode == 0, (self.folder / "log").read_text()
        return time.monotonic() - started

    def kill(self, delay: float, before: Callable[[], None] = lambda: None) -> float | None:
        """Begin or go on, kill after `delay` [s]; seconds until the last of its processes was gone, None if done.

        before: called right before the kill, or once it is done.
        """
        process = self.begin()
        process.join(delay)
        before()
        if process.exitcode is not None:
            assert process.exitcode == 0, (self.folder / "log").read_text()
            return None
        assert process.pid is not None
        os.kill(process.pid, 9)
        killed = time.monotonic()
        while living(process.pid):
            assert time.monotonic() - killed < PATIENCE
            time.sleep(0.02)
        process.join(PATIENCE)
        return time.monotonic() - killed


def contents(journals: Path) -> dict[str, bytes]:
    """The bytes of every finished episode."""
    return {path.name: path.read_bytes() for path in list_episodes(journals)}
