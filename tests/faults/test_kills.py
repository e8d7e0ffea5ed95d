"""A recorder that is killed, at any moment and again and again, loses at most the episodes in hand."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from manip_il.data.journal import list_episodes, read_journal
from manip_il.doctor.examine import examine_folder
from manip_il.doctor.finding import Severity

from ..damage import digests
from .killed import Command, contents

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("MANIP_IL_KILLS", "4"))  # for each number of workers
WORDS = ("record", "--robot.type=fetch", "--task.type=reach", "--dataset.num_episodes=8")


@pytest.mark.parametrize("workers", [1, 2])
def test_no_kill_loses_a_finished_episode_or_leaves_a_dataset_that_cannot_be_read(start, tmp_path, workers):
    def recorder(folder: Path) -> Command:
        words = (*WORDS, "--dataset.root={folder}/demos", f"--workers={workers}")
        return Command(start, words, folder, kept=folder / "demos.journals")

    calm = recorder(tmp_path / "calm")
    calm.run()  # the first also pays for what is loaded once
    seconds = calm.run("--overwrite=true")
    expected, episodes = digests(calm.folder / "demos"), contents(calm.kept)
    rng = np.random.default_rng(workers)
    kills, chain = 0, 0
    while kills < KILLS:
        chain += 1
        again = recorder(tmp_path / f"chain_{chain}")
        root, kept = again.folder / "demos", again.kept
        while kills < KILLS:
            finished: dict[str, bytes] = {}
            look = partial(lambda found, folder: found.update(contents(folder)), finished, kept)
            killed = again.kill(rng.uniform(0, seconds), before=look)
            after = contents(kept)
            assert finished.items() <= after.items()
            assert after.items() <= episodes.items()
            assert not root.exists() or digests(root) == expected
            if killed is None:
                break
            kills += 1
        again.run()
        assert digests(root) == expected
        assert contents(kept) == episodes
        assert [one for one in examine_folder(root) if one.severity is Severity.ERROR] == []
        assert sorted(path.name for path in again.folder.iterdir()) == ["demos", "demos.journals", "log"]
    for path in list_episodes(calm.kept):
        read_journal(path)
