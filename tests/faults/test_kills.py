"""A recorder that is killed, at any moment and again and again, loses at most the episodes in hand."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest

from manip_il.data.journal import list_episodes, read_episode
from manip_il.doctor.examine import examine_folder
from manip_il.doctor.finding import Severity

pytestmark = pytest.mark.slow

EPISODES = 8
KILLS = int(os.environ.get("MANIP_IL_KILLS", "4"))  # for each number of workers
PATIENCE = 600.0  # for a recorder that is not killed [s]


@dataclass
class Recorder:
    """Records into `folder`, is killed, and goes on."""

    start: Callable[..., ForkServerProcess]
    folder: Path
    workers: int

    @property
    def root(self) -> Path:
        return self.folder / "demos"

    @property
    def journals(self) -> Path:
        return self.folder / "demos.journals"

    def begin(self, *more: str):
        words = ["--robot.type=fetch", "--task.type=reach", f"--dataset.num_episodes={EPISODES}"]
        words += [f"--dataset.root={self.root}", f"--workers={self.workers}", *more]
        return self.start("record", *words, log=self.folder / "log")

    @property
    def resume(self) -> list[str]:
        """Where something is there to be resumed: a kill may come before that."""
        return ["--resume=true"] if self.journals.is_dir() and any(self.journals.iterdir()) else []

    def run(self, *more: str) -> float:
        """Seconds that an undisturbed recording takes."""
        started = time.monotonic()
        process = self.begin(*more)
        process.join(PATIENCE)
        assert process.exitcode == 0, (self.folder / "log").read_text()
        return time.monotonic() - started


@pytest.mark.parametrize("workers", [1, 2])
def test_no_kill_loses_a_finished_episode_or_leaves_a_dataset_that_cannot_be_read(start, tree_of, tmp_path, workers):
    (tmp_path / "calm").mkdir()
    calm = Recorder(start, tmp_path / "calm", workers)
    calm.run()  # the first also pays for what is loaded once
    seconds = calm.run("--overwrite=true")
    expected, episodes = tree_of(calm.root), contents(calm.journals)
    rng = np.random.default_rng(workers)
    kills, chain = 0, 0
    while kills < KILLS:
        chain += 1
        folder = tmp_path / f"chain_{chain}"
        folder.mkdir()
        recorder = Recorder(start, folder, workers)
        while kills < KILLS:
            killed, finished = kill_one(recorder, rng.uniform(0, seconds))
            kills += killed
            after = contents(recorder.journals)
            assert finished.items() <= after.items()
            assert after.items() <= episodes.items()
            assert not recorder.root.exists() or tree_of(recorder.root) == expected
            if not killed:
                break
        recorder.run(*recorder.resume)
        assert tree_of(recorder.root) == expected
        assert contents(recorder.journals) == episodes
        assert [one for one in examine_folder(recorder.root) if one.severity is Severity.ERROR] == []
        assert sorted(path.name for path in folder.iterdir()) == ["demos", "demos.journals", "log"]
    for path in list_episodes(calm.journals):
        read_episode(path)


def kill_one(recorder: Recorder, delay: float) -> tuple[bool, dict[str, bytes]]:
    """Start or go on, kill after `delay` [s]; whether it was still at work, and the episodes it had finished then."""
    process = recorder.begin(*recorder.resume)
    process.join(delay)
    finished = contents(recorder.journals)
    if process.exitcode is not None:
        assert process.exitcode == 0, (recorder.folder / "log").read_text()
        return False, finished
    assert process.pid is not None
    os.kill(process.pid, 9)
    process.join(PATIENCE)
    return True, finished


def contents(journals: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in list_episodes(journals)}
