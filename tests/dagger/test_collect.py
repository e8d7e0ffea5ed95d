"""Episodes on disk: what is there is not run again, and what comes out depends on the seeds alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from manip_il.dagger.collect import build_dataset, check_journals, collect, collect_successes
from manip_il.data.journal import list_episodes, read_episode, read_header
from manip_il.data.lerobot_io import read_table
from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.engine.local import Engine, Keep
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import Episode
from manip_il.sim.env import EnvConfig

JOB = RolloutJob(EnvConfig("fetch", "reach", horizon=30), "expert", hold=1)
SEEDS = range(1_000_000, 1_000_012)


class Recorded(Engine):
    """Plays episodes from the real engine, those of `failing` seeds as failures; remembers what it was asked for."""

    def __init__(self, failing: Sequence[int] = ()):
        super().__init__(1)
        self.asked: list[int] = []
        self._failing = set(failing)

    def run(self, job: RolloutJob, seeds: Sequence[int], keep: Keep | None = None) -> Iterator[Episode]:
        self.asked += seeds
        for episode in run_job(job, seeds):
            if episode.seed in self._failing:
                lost = episode.columns | {"next.success": np.zeros_like(episode.columns["next.success"])}
                episode = Episode(episode.seed, lost, False, False)
            if keep is not None:
                keep(episode)
            yield episode


def names(folder: Path) -> list[int]:
    return [read_header(path).seed for path in list_episodes(folder)]


def test_every_seed_becomes_a_file_that_holds_its_episode(tmp_path):
    seen: list[Episode] = []
    collect(Recorded(), JOB, SEEDS[:3], tmp_path, seen.append)
    assert names(tmp_path) == list(SEEDS[:3])
    by_seed = {episode.seed: episode for episode in seen}
    for path in list_episodes(tmp_path):
        episode = read_episode(path)
        for key, column in by_seed[episode.seed].columns.items():
            assert episode.columns[key].tobytes() == column.tobytes()


def test_what_is_there_is_not_run_again(tmp_path):
    collect(Recorded(), JOB, SEEDS[:2], tmp_path)
    engine = Recorded()
    collect(engine, JOB, SEEDS[:4], tmp_path)
    assert engine.asked == list(SEEDS[2:4])


def test_an_episode_is_on_disk_before_anybody_hears_of_it(tmp_path):
    def stop(episode: Episode) -> None:
        assert episode.seed in names(tmp_path)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(Recorded(), JOB, SEEDS[:3], tmp_path, stop)
    assert len(names(tmp_path)) == 1


def test_a_failed_demonstration_is_replaced_by_the_next_seeds(tmp_path):
    failing = [SEEDS[0], SEEDS[2], SEEDS[4]]
    good = collect_successes(Recorded(failing), JOB, SEEDS, 4, tmp_path)
    assert [read_header(path).seed for path in good] == [SEEDS[1], SEEDS[3], SEEDS[5], SEEDS[6]]


def test_which_demonstrations_come_out_does_not_depend_on_what_was_there(tmp_path):
    failing = [SEEDS[1]]
    first = collect_successes(Recorded(failing), JOB, SEEDS, 3, tmp_path / "a")
    collect(Recorded(failing), JOB, SEEDS[2:8], tmp_path / "b")
    second = collect_successes(Recorded(failing), JOB, SEEDS, 3, tmp_path / "b")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_an_expert_that_mostly_fails_is_given_up(tmp_path):
    with pytest.raises(ManipError, match="only 0 of 9 demonstrations succeeded; 3 were asked for"):
        collect_successes(Recorded(SEEDS), JOB, SEEDS[:9], 3, tmp_path)


def test_journals_of_another_environment_are_not_gone_on_with(tmp_path):
    assert check_journals(tmp_path, JOB) == []
    collect(Recorded(), JOB, SEEDS[:1], tmp_path)
    assert check_journals(tmp_path, JOB) == []
    with pytest.raises(MismatchError, match=r"robot.*fetch.*panda"):
        check_journals(tmp_path, RolloutJob(EnvConfig("panda", "reach"), "expert"))
    warnings = check_journals(tmp_path, RolloutJob(EnvConfig("fetch", "reach", tolerance=0.05), "expert"))
    assert len(warnings) == 1


@pytest.mark.slow  # imports LeRobot
def test_a_dataset_holds_its_journals_in_the_order_given(tmp_path):
    collect(Recorded(), JOB, SEEDS[:3], tmp_path / "journals")
    paths = list_episodes(tmp_path / "journals")[::-1]
    build_dataset(paths, tmp_path / "dataset", JOB, "local/x", {})
    table = read_table(tmp_path / "dataset", ("seed", "executed_action"))
    expected = [read_episode(path) for path in paths]
    np.testing.assert_array_equal(table["seed"].ravel(), np.repeat(SEEDS[2::-1], list(map(len, expected))))
    executed = np.concatenate([episode.columns["executed_action"] for episode in expected])
    np.testing.assert_array_equal(table["executed_action"], executed)
