"""Where episodes run does not matter, and a worker that dies costs no episode."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from kept import DeadlyKeep, FailingKeep, contents, journal

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine, split
from manip_il.data.journal import list_seeds
from manip_il.errors import ManipError
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig

from ..faults.child import living
from ..test_child_processes import wait_for

SEEDS = stream_seeds("certificate", 6)
JOB = RolloutJob(EnvConfig("fetch", "reach"), hold=3)


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> dict[str, bytes]:
    """What this process alone writes."""
    folder = tmp_path_factory.mktemp("here")
    assert len(list(Engine().run(JOB, SEEDS, journal(folder, JOB)))) == len(SEEDS)
    return contents(folder)


@pytest.mark.parametrize(("seeds", "workers"), [(1, 2), (7, 2), (60, 2), (200, 3)])
def test_every_seed_is_in_one_task_and_no_worker_idles(seeds: int, workers: int):
    learner = replace(JOB, driver=PolicyDriver((Path("x"),)))
    for job in (JOB, learner):
        tasks = split(job, range(seeds), workers)
        assert [seed for task in tasks for seed in task] == list(range(seeds))
        assert len(tasks) >= min(seeds, workers)
    assert max(len(task) for task in tasks) <= 25


@pytest.mark.slow
def test_an_episode_is_on_disk_before_it_arrives(two_processes, tmp_path, expected):
    for episode in two_processes.run(JOB, SEEDS, journal(tmp_path, JOB)):
        assert episode.seed in list_seeds(tmp_path)
    assert contents(tmp_path) == expected


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced_and_its_seed_runs_again(two_processes, tmp_path, expected):
    keep = DeadlyKeep.of(tmp_path, JOB, SEEDS[1], SEEDS[4], times=2)
    episodes = list(two_processes.run(JOB, SEEDS, keep))
    assert sorted(episode.seed for episode in episodes) == list(SEEDS)
    assert contents(tmp_path / "journals") == expected
    assert keep.deaths() == 4
    assert two_processes.given_up == []


@pytest.mark.slow
def test_a_seed_that_kills_its_worker_three_times_is_left_out_and_named(tmp_path, expected):
    keep = DeadlyKeep.of(tmp_path, JOB, SEEDS[2])
    with Engine(2) as engine:
        episodes = list(engine.run(JOB, SEEDS, keep))
        assert engine.given_up == [SEEDS[2]]
        assert [*engine.run(JOB, [SEEDS[2]], keep)] == []  # known by now
    assert sorted(episode.seed for episode in episodes) == [seed for seed in SEEDS if seed != SEEDS[2]]
    assert 3 <= keep.deaths() <= 4  # the first time it may not have been alone


@pytest.mark.slow
def test_of_a_lockstep_batch_only_the_seed_that_kills_is_left_out(checkpoint, tmp_path):
    job = RolloutJob(EnvConfig(horizon=10), PolicyDriver((checkpoint,)), label="per_state")
    keep = DeadlyKeep.of(tmp_path, job, SEEDS[0])
    with Engine(2) as engine:
        done = {episode.seed for episode in engine.run(job, SEEDS, keep)}
        assert engine.given_up == [SEEDS[0]]
    assert done == set(SEEDS[1:]) == set(list_seeds(tmp_path / "journals"))


@pytest.mark.slow
def test_where_every_worker_dies_the_work_ends_with_an_error(tmp_path):
    seeds = stream_seeds("certificate", 40)
    keep = DeadlyKeep.of(tmp_path, JOB, *seeds)
    with Engine(2) as engine, pytest.raises(ManipError, match="rollout workers died one after the other"):
        list(engine.run(JOB, seeds, keep))


@pytest.mark.slow
def test_what_a_worker_raises_arrives_and_the_engine_goes_on(two_processes, tmp_path):
    with pytest.raises(ManipError, match="no such folder"):
        list(two_processes.run(RolloutJob(EnvConfig(), PolicyDriver((Path("no such folder"),))), SEEDS))
    with pytest.raises(ManipError, match=r"No space left on device.*episode of seed"):
        list(two_processes.run(JOB, SEEDS, FailingKeep()))
    assert len(list(two_processes.run(JOB, SEEDS[:2]))) == 2


@pytest.mark.slow
def test_workers_end_with_the_process_that_started_them():
    code = (
        "from multiprocessing import forkserver, resource_tracker\n"
        "from manip_il.collect.workers import Engine\n"
        "from manip_il.collect.job import RolloutJob\n"
        "from manip_il.sim.env import EnvConfig\n"
        "engine = Engine(2)\n"
        "for episode in engine.run(RolloutJob(EnvConfig()), range(1000)):\n"
        "    pids = list(engine._pool._pool._processes)\n"
        "    pids += [forkserver._forkserver._forkserver_pid, resource_tracker._resource_tracker._pid]\n"
        "    print(pids, flush=True)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert parent.stdout is not None
    pids = [int(pid) for pid in parent.stdout.readline().strip("[]\n").split(",")]
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_for(lambda: not set(pids) & set(living(parent.pid)))
