from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))  # where children find `child`

from child import run_command

_PRELOAD = [
    "manip_il.cli.record",
    "manip_il.cli.stages",
    "manip_il.cli.dagger",
    "manip_il.cli.evaluate",
    "manip_il.cli.shown",
    "manip_il.algorithms.run",
    "manip_il.evaluation.eval_report",
    "manip_il.learn.policy",
    "manip_il.learn.train",
    "manip_il.recording",
    "manip_il.engine.local",
    "pyarrow.parquet",
]


@pytest.fixture(scope="session")
def start(tmp_path_factory) -> Callable[..., ForkServerProcess]:
    """Starts a command in a process of its own within milliseconds: what it imports is loaded once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOAD)

    def begin(*words: str, log: Path, warm: bool = False) -> ForkServerProcess:
        process = context.Process(target=run_command, args=(words, str(log), warm))
        process.start()
        return process

    return begin


@pytest.fixture(scope="session")
def tree_of() -> Callable[[Path], dict[str, bytes]]:
    """Every file's content under a folder."""

    def read(root: Path) -> dict[str, bytes]:
        return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}

    return read
