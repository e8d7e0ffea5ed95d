"""Where episodes run does not matter: in processes, and on a Ray cluster. A worker that dies ends
a local run with one line; Ray runs its seeds again.
"""

import contextlib
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import ray
from kept import DeadlyJournal, contents, written
from ray.cluster_utils import Cluster

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.record import journal_of
from manip_il.collect.workers import Engine, map_in_order
from manip_il.data.journal import list_seeds
from manip_il.errors import ManipError
from manip_il.seeding import stream_seeds
from manip_il.worlds.table import make_config

from ..faults.child import living

SEEDS = stream_seeds("certificate", 8)
JOB = RolloutJob(make_config("fetch", "reach"), hold=3)
PROGRAM = """
import os, time
from manip_il.collect.workers import open_pool
pool = open_pool(1)
print(pool.submit(os.getpid).result(), flush=True)
pool.submit(time.sleep, 3600).result()
"""
PATIENCE = 600.0  # for whatever comes in the end, on a machine that does much else [s]
both_backends = pytest.mark.parametrize("backend", ["local", "ray"])


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> dict[str, bytes]:
    """What this process alone writes."""
    folder = tmp_path_factory.mktemp("here")
    assert len(list(Engine().run(JOB, SEEDS, journal_of(folder, JOB)))) == len(SEEDS)
    return contents(folder)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory) -> Iterator[Cluster]:
    """Two nodes of one core each on this machine, whose workers find `kept`."""
    patch = pytest.MonkeyPatch()
    # workers on this machine would find its packages there
    patch.chdir(tmp_path_factory.mktemp("cwd"))
    patch.setenv("PYTHONPATH", f"{Path(__file__).parent}:{Path(__file__).parents[2]}")
    # a dead node is missed five times
    quick = {"health_check_initial_delay_ms": 500, "health_check_period_ms": 500}
    two = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "_system_config": quick})
    two.add_node(num_cpus=1)
    two.wait_for_nodes(PATIENCE)
    ray.init(address=two.address, log_to_driver=False, logging_level=logging.ERROR)
    yield two
    ray.shutdown()
    two.shutdown()
    patch.undo()


@pytest.fixture
def engine(backend: str, request: pytest.FixtureRequest) -> Iterator[Engine]:
    if backend == "ray":
        request.getfixturevalue("cluster")
    with Engine(2, backend) as two:
        yield two


@pytest.mark.slow
@both_backends
def test_an_episode_is_on_disk_before_it_arrives_with_the_bytes_of_one_process(
    engine: Engine, tmp_path, expected
):
    for episode in engine.run(JOB, SEEDS, journal_of(tmp_path, JOB)):
        assert episode.seed in list_seeds(tmp_path)
    assert contents(tmp_path) == expected


@pytest.mark.slow
@both_backends
def test_a_policy_acts_the_same_everywhere(engine: Engine, checkpoint):
    job = RolloutJob(make_config(horizon=10), PolicyDriver.of(checkpoint, beta=0.5))
    assert written(engine.run(job, SEEDS[:4])) == written(job.run(SEEDS[:4]))


@pytest.mark.slow
@both_backends
def test_a_death_is_told_by_a_process_and_undone_by_ray(
    engine: Engine, backend: str, tmp_path, expected
):
    once = DeadlyJournal.of(tmp_path, JOB, SEEDS[1], times=1)
    if backend == "ray":
        assert sorted(episode.seed for episode in engine.run(JOB, SEEDS, once)) == list(SEEDS)
        assert contents(tmp_path / "journals") == expected
    else:
        with pytest.raises(ManipError, match="a worker died"):
            list(engine.run(JOB, SEEDS, once))
        assert len(list(engine.run(JOB, SEEDS[:2]))) == 2
    assert once.deaths() == 1


@pytest.mark.slow
@both_backends
def test_what_a_worker_raises_arrives_as_one_line_and_the_engine_goes_on(engine: Engine, tmp_path):
    with pytest.raises(ManipError, match="unknown robot 'nobody'"):
        list(engine.run(replace(JOB, env=replace(JOB.env, robot="nobody")), SEEDS))
    (tmp_path / "file").write_text("")
    with pytest.raises(ManipError, match="Not a directory") as caught:
        list(engine.run(JOB, SEEDS, journal_of(tmp_path / "file" / "journals", JOB)))
    assert "\n" not in str(caught.value)
    assert len(list(engine.run(JOB, SEEDS[:2]))) == 2


@pytest.mark.slow
def test_nodes_come_and_go(cluster, tmp_path, expected):
    node, counts = cluster.add_node(num_cpus=1), list[int]()
    cluster.wait_for_nodes(PATIENCE)
    with Engine(None, "ray") as engine:
        for count, _ in enumerate(engine.run(JOB, SEEDS, journal_of(tmp_path, JOB))):
            if count == 1:
                cluster.remove_node(node, allow_graceful=False)
            counts.append(engine._pool.count)
    assert counts[0] == 3
    assert contents(tmp_path) == expected


@pytest.mark.slow
def test_a_worker_ignores_ctrl_c_and_ends_with_its_parent():
    command = [sys.executable, "-c", PROGRAM]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        os.kill(child, signal.SIGINT)
        time.sleep(0.5)
        assert child in living(parent.pid)
        parent.kill()
        parent.wait()
        ends = time.monotonic() + PATIENCE
        while child in living(parent.pid):
            assert time.monotonic() < ends
            time.sleep(0.02)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)


@pytest.mark.slow
def test_results_come_in_the_order_of_the_items_and_a_death_is_told():
    for workers in (1, 2):
        assert list(map_in_order(abs, range(-9, 0), workers)) == [
            (item, -item) for item in range(-9, 0)
        ]
    with pytest.raises(ManipError, match="a worker died"):
        list(map_in_order(os._exit, [1], 2))
