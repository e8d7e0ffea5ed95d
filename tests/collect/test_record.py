"""Episodes on disk: what is there is not run again, and what comes out depends on the seeds
alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.collect.job import RolloutJob
from manip_il.collect.record import collect, collect_successes, journal_of
from manip_il.collect.workers import Engine
from manip_il.data.journal import Journal, list_episodes, list_seeds
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import Episode
from manip_il.sim.config import CameraConfig
from manip_il.worlds.table import make_config

JOB = RolloutJob(make_config("fetch", "reach", horizon=30), hold=1)
SEEDS = range(1_000_000, 1_000_012)


class Recorded(Engine):
    """Plays episodes from the real engine, those of `failing` seeds as failures.

    Remembers what it was asked for.
    """

    def __init__(self, failing: Sequence[int] = ()):
        super().__init__(1)
        self.asked: list[int] = []
        self._failing = set(failing)

    def run(
        self, job: RolloutJob, seeds: Sequence[int], journal: Journal | None = None
    ) -> Iterator[Episode]:
        self.asked += seeds
        for episode in job.run(seeds):
            if episode.seed in self._failing:
                lost = episode.columns | {
                    "next.success": np.zeros_like(episode.columns["next.success"])
                }
                episode = Episode(episode.seed, lost, False, False)
            if journal is not None:
                journal.store(episode.seed, journal.encode(episode))
            yield episode


def contents(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in list_episodes(folder)]


def test_what_is_there_is_not_run_again_and_what_came_is_on_disk_before_anybody_hears_of_it(
    tmp_path,
):
    def stop(episode: Episode) -> None:
        assert list_seeds(tmp_path) == [episode.seed]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(collect(Recorded(), JOB, SEEDS[:3], tmp_path, stop))
    engine = Recorded()
    assert len(list(collect(engine, JOB, SEEDS[:4], tmp_path))) == 4
    assert engine.asked == list(SEEDS[1:4])


def test_an_expert_that_mostly_fails_is_given_up(tmp_path):
    with pytest.raises(ManipError, match="only 0 of 9 demonstrations succeeded; 3 are needed"):
        list(collect_successes(Recorded(SEEDS), JOB, SEEDS[:9], 3, tmp_path))


class Shuffled(Recorded):
    """Episodes end in another order than their seeds'."""

    def run(
        self, job: RolloutJob, seeds: Sequence[int], journal: Journal | None = None
    ) -> Iterator[Episode]:
        yield from super().run(job, seeds[::-1], journal)


def test_journals_come_in_the_order_of_the_seeds(tmp_path):
    found = list(collect(Shuffled(), JOB, SEEDS[:5], tmp_path))
    assert [episode.seed for _, episode in found] == list(SEEDS[:5])


def test_journals_of_another_environment_are_not_gone_on_with(tmp_path, caplog):
    journal_of(tmp_path, JOB).prepare()
    list(collect(Recorded(), JOB, SEEDS[:1], tmp_path))
    journal_of(tmp_path, JOB).prepare()
    for other in (
        replace(JOB, env=make_config("panda", "reach")),
        replace(JOB, cameras=CameraConfig(("front",))),
    ):
        with pytest.raises(MismatchError):
            journal_of(tmp_path, other).prepare()
    assert not caplog.messages
    looser = replace(JOB, env=make_config("fetch", "reach", tolerance=0.05))
    journal_of(tmp_path, looser).prepare()
    assert len(caplog.messages) == 1
