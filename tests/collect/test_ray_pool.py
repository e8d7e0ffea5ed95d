"""On Ray the same episodes come home, whatever becomes of a node."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import ray
from kept import DeadlyKeep, contents, journal
from ray.cluster_utils import Cluster

from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.errors import ManipError
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig

pytestmark = pytest.mark.slow

SEEDS = stream_seeds("certificate", 16)
JOB = RolloutJob(EnvConfig("fetch"), hold=3)


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> dict[str, bytes]:
    """What this process alone writes."""
    folder = tmp_path_factory.mktemp("here")
    list(Engine().run(JOB, SEEDS, journal(folder, JOB)))
    return contents(folder)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory) -> Iterator[Cluster]:
    """Two nodes of one core each on this machine, whose workers find `kept`."""
    patch = pytest.MonkeyPatch()
    patch.chdir(tmp_path_factory.mktemp("cwd"))  # workers on this machine would find its packages there
    patch.setenv("PYTHONPATH", str(Path(__file__).parent))
    quick = {"health_check_initial_delay_ms": 500, "health_check_period_ms": 500}  # a dead node is missed five times
    head = {"num_cpus": 1, "include_dashboard": False, "_system_config": quick}
    two = Cluster(initialize_head=True, head_node_args=head)
    two.add_node(num_cpus=1)
    two.wait_for_nodes()
    ray.init(address=two.address, log_to_driver=False, logging_level=logging.ERROR)
    yield two
    ray.shutdown()
    two.shutdown()
    patch.undo()


def test_a_cluster_writes_what_this_process_writes(cluster, tmp_path, expected):
    with Engine(None, "ray") as engine:
        assert len(list(engine.run(JOB, SEEDS, journal(tmp_path, JOB)))) == len(SEEDS)
    assert contents(tmp_path) == expected


def test_a_policy_acts_the_same_on_a_cluster(cluster, checkpoint):
    job = RolloutJob(EnvConfig(horizon=10), PolicyDriver((checkpoint,)))
    with Engine(2, "ray") as engine:
        there = {episode.seed: episode for episode in engine.run(job, SEEDS[:4])}
    for episode in Engine().run(job, SEEDS[:4]):
        for key, column in episode.columns.items():
            assert there[episode.seed].columns[key].tobytes() == column.tobytes()


def test_a_seed_that_kills_its_worker_is_left_out_there_too(cluster, tmp_path, expected):
    keep = DeadlyKeep.of(tmp_path, JOB, SEEDS[2])
    with Engine(2, "ray") as engine:
        done = {episode.seed for episode in engine.run(JOB, SEEDS[:5], keep)}
        assert engine.given_up == [SEEDS[2]]
    assert done == {SEEDS[0], SEEDS[1], SEEDS[3], SEEDS[4]}
    assert contents(tmp_path / "journals").items() <= expected.items()
    assert 3 <= keep.deaths() <= 4  # the first time it may not have been alone


def test_what_the_work_raises_comes_home(cluster):
    with Engine(2, "ray") as engine, pytest.raises(ManipError, match="unknown robot 'nobody'"):
        list(engine.run(replace(JOB, env=replace(JOB.env, robot="nobody")), SEEDS))


def test_a_node_that_is_killed_costs_no_episode(cluster, tmp_path, expected):
    node = cluster.add_node(num_cpus=2)
    cluster.wait_for_nodes()
    with Engine(4, "ray") as engine:
        for count, _ in enumerate(engine.run(JOB, SEEDS, journal(tmp_path, JOB))):
            if count == 3:
                cluster.remove_node(node, allow_graceful=False)
        assert engine.given_up == []
    assert contents(tmp_path) == expected


STUBS = {"No module named 'manip_il": None, "has manip_il 0.0.0, not": '__version__ = "0.0.0"'}


@ray.remote(num_cpus=1)
def sleep() -> None:
    time.sleep(600)


@pytest.fixture
def only_new_nodes(cluster) -> Iterator[None]:
    """The nodes that are there have something else to do."""
    busy = [sleep.remote() for _ in range(2)]
    while ray.available_resources().get("CPU", 0):
        time.sleep(0.1)
    yield
    for reference in busy:
        ray.cancel(reference, force=True)


@pytest.mark.parametrize("words", STUBS)
def test_a_node_with_another_version_is_one_line(cluster, only_new_nodes, tmp_path, monkeypatch, words: str):
    """Or without the program."""
    package = tmp_path / "stub" / "manip_il"
    package.mkdir(parents=True)
    raised = "raise ModuleNotFoundError(\"No module named 'manip_il'\")"
    (package / "__init__.py").write_text(STUBS[words] or raised)
    monkeypatch.setenv("PYTHONPATH", str(package.parent))
    node = cluster.add_node(num_cpus=4)
    cluster.wait_for_nodes()
    try:
        with Engine(6, "ray") as engine, pytest.raises(ManipError, match=words) as caught:
            list(engine.run(JOB, SEEDS))
    finally:
        cluster.remove_node(node)
    assert "\n" not in str(caught.value)


def test_a_node_that_comes_later_gets_work_too(cluster, tmp_path, expected):
    node, seen = None, set[int]()
    with Engine(None, "ray") as engine:
        for count, _ in enumerate(engine.run(JOB, SEEDS, journal(tmp_path, JOB))):
            if count == 1:
                node = cluster.add_node(num_cpus=2)
            time.sleep(0.5)  # so that it can answer before the last seed is given away
            seen.add(engine._pool.count)  # pyright: ignore
    cluster.remove_node(node)
    assert (min(seen), max(seen)) == (2, 4)
    assert contents(tmp_path) == expected
