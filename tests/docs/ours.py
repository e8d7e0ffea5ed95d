"""A process in which a page's commands and snippets run, one after the other: its memory goes
back with it.
"""

import contextlib
import gc
import os
import shlex
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from ..faults.child import fork_instead_of_spawning, say_into
from ..store.servers import talk_to


class Ours(AbstractContextManager["Ours"]):
    """The process starts within milliseconds, as what it imports is loaded once, when it is
    first needed.
    """

    def __init__(self, log: Path, environment: Mapping[str, str]) -> None:
        self._log, given = log, (str(log), dict(environment))
        self._pool = ProcessPoolExecutor(1, get_context("forkserver"), _begin, given)

    def run(self, words: list[str], folder: Path, what: str) -> None:
        """Run the words behind `manip-il` in a folder; fail unless they end with exit code 0."""
        code = self._pool.submit(_run, words, folder).result()
        assert code == 0, (
            f"{what}\nas: manip-il"
            f" {shlex.join(words)}\n{self._log.read_text(errors='replace')[-4000:]}"
        )

    def execute(self, code: str, folder: Path, name: str) -> None:
        """Execute a snippet in a folder.

        A task that it defines is kept there as a file, as the pages ask.
        """
        self._pool.submit(_execute, code, folder, name).result()

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown()


def _begin(log: str, environment: dict[str, str]) -> None:
    from manip_il.evaluation import film

    gc.freeze()
    os.environ.clear()
    os.environ.update(environment)
    say_into(log)
    fork_instead_of_spawning()
    talk_to(environment["HF_ENDPOINT"])
    film.FILM_EVERY = 20  # a frame a second: drawing all takes most of the demo's time


def _run(words: list[str], folder: Path) -> int:
    from manip_il.cli.main import main

    with contextlib.chdir(folder):
        return main(words)


def _execute(code: str, folder: Path, name: str) -> None:
    names: dict[str, Any] = {"__name__": "__main__"}
    with contextlib.chdir(folder):
        exec(compile(code, name, "exec"), names)
        for one in names.values():
            if isinstance(one, type) and one.__module__ == "__main__" and hasattr(one, "rungs"):
                Path(f"{one.name}.py").write_text(code)
