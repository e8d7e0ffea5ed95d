"""Recording on four local Ray nodes of one core each, against one such node and against two
processes.

python benchmarks/ray_nodes.py [--quick]

All record journals of the same episodes, alternating, with warm workers; medians over the turns,
with their range. "four nodes / two processes" is the overhead of Ray, as both share the same cores.
"over the wire" is the packed size of an episode that a worker sends back.
"""

import argparse
import logging
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import ray
from _machine import describe_machine
from ray.cluster_utils import Cluster

from manip_il import __version__
from manip_il.collect.job import RolloutJob
from manip_il.collect.ray_pool import run_there
from manip_il.collect.workers import Engine
from manip_il.data.journal import Journal
from manip_il.seeding import stream_seeds
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

NODES = 4
TURNS = 5


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few episodes: shows that it runs, measures little"
    )
    quick = parser.parse_args().quick
    episodes, turns = (4, 1) if quick else (60, TURNS)
    job = RolloutJob(make_config("panda"))
    print(describe_machine())
    print(f"over the wire: {wire(job):,.0f} bytes an episode of panda pick_place")
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    for _ in range(1, NODES):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    try:
        ray.init(address=cluster.address, log_to_driver=False, logging_level=logging.ERROR)
        with Engine(None, "ray") as four, Engine(1, "ray") as one, Engine(2) as local:
            ways = {"two processes": local, "four nodes": four, "one node": one}
            times = measured(
                {name: recorder(engine, job) for name, engine in ways.items()}, episodes, turns
            )
    finally:
        ray.shutdown()
        cluster.shutdown()
    for name, seconds in times.items():
        print(f"{name:14s} {episodes / statistics.median(seconds):7.2f} episodes/s")
    print(
        "four nodes / two processes, time an episode:",
        spread(times["four nodes"], times["two processes"]),
    )
    print(
        "one node / four nodes, time an episode:     ",
        spread(times["one node"], times["four nodes"]),
    )
    return 0


def recorder(engine: Engine, job: RolloutJob) -> Callable[[int], float]:
    """Return a function that records a number of episodes and returns the time it took [s]."""

    def record(count: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            keep = Journal(Path(folder), env_spec(job.env), env_fingerprint(job.env))
            started = time.perf_counter()
            done = sum(1 for _ in engine.run(job, stream_seeds("certificate", count), keep))
            assert done == count == len(list(Path(folder).glob("*.mcap")))
            return time.perf_counter() - started

    return record


def measured(
    ways: dict[str, Callable[[int], float]], episodes: int, turns: int
) -> dict[str, list[float]]:
    for record in ways.values():
        record(2 * NODES)  # starts the workers, which import and compile
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(turns):
        for name, record in ways.items():
            times[name].append(record(episodes))
    return times


def wire(job: RolloutJob) -> float:
    """Return the size of an episode as a worker sends it back [bytes]."""
    with tempfile.TemporaryDirectory() as folder:
        keep = Journal(Path(folder), env_spec(job.env), env_fingerprint(job.env))
        seeds = tuple(stream_seeds("certificate", 8))
        return len(run_there(__version__, job, seeds, keep, None, None, None)) / len(seeds)


def spread(above: list[float], below: list[float]) -> str:
    ratios = sorted(a / b for a, b in zip(above, below, strict=True))
    return f"{statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})"


if __name__ == "__main__":
    sys.exit(main())
