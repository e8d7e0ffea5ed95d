"""Recording end to end (simulate, label, journal, dataset) against the cost of its parts alone, in
the same run.

python benchmarks/recording_speed.py [--quick]

One core: this process is pinned to one core, including the threads that encode video. The limit is
`mj_step` replaying the recorded controls from the same starts, plus, with cameras, rendering the
same pictures; episodes alternate. "encoding beside it": video is encoded on a second core, as in
`record`; recordings and their limits alternate. Two workers: the same recording with two processes
against one, all warm, and bare physics with two processes against one, which is the machine's
limit. The result is the median ratio over the repeats.
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from _machine import describe_machine

from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import make_config

# Mesa renders on the calling core, here and in the limit
os.environ.setdefault("LP_NUM_THREADS", "0")

from manip_il.collect.job import RolloutJob
from manip_il.collect.record import collect, provenance
from manip_il.collect.workers import Engine
from manip_il.data.build import Recording
from manip_il.data.journal import Journal, episode_path, list_episodes, read_journal
from manip_il.mdp import Episode
from manip_il.robots import ROBOTS
from manip_il.seeding import stream_seeds
from manip_il.sim.config import CameraConfig
from manip_il.sim.render import pictures

HOLD = 10  # as in `manip-il record`
CAMERAS = CameraConfig(("front", "wrist"))
BARE_STEPS = 50_000  # steps of bare physics, to measure the gain from a second process


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="few episodes: shows that it runs, measures little"
    )
    quick = parser.parse_args().quick
    print(describe_machine())
    print(
        "recording                       control steps/s  limit, control steps/s  share (median,"
        " all repeats)"
    )
    for robot in ROBOTS:
        job = RolloutJob(make_config(robot), hold=HOLD)
        report(f"{robot}, one core", *one_core(job, 2 if quick else 40, 2 if quick else 5))
    for robot in ROBOTS:
        job = RolloutJob(make_config(robot), hold=HOLD, cameras=CAMERAS)
        report(
            f"{robot}, two cameras, one core", *one_core(job, 1 if quick else 8, 2 if quick else 3)
        )
        report(f"{robot}, encoding beside it", *beside(job, 1 if quick else 8, 2 if quick else 3))
    print("two workers against one       recording              bare physics: the machine's limit")
    for robot in ROBOTS:
        job = RolloutJob(make_config(robot), hold=HOLD)
        two_workers(robot, job, 8 if quick else 80, 2 if quick else 3)
    return 0


def report(name: str, ours: list[float], limits: list[float]) -> None:
    shares = [one / limit for one, limit in zip(ours, limits, strict=True)]
    rates = f"{statistics.median(ours):15,.0f}  {statistics.median(limits):22,.0f}"
    print(f"{name:30s}  {rates}  {spread(shares)}")


def one_core(job: RolloutJob, episodes: int, repeats: int) -> tuple[list[float], list[float]]:
    """Return control steps per second on one core: of recording, and of its limit."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        # the first one loads and compiles
        measured = [steps_per_second(job, episodes) for _ in range(repeats + 1)][1:]
    finally:
        os.sched_setaffinity(0, cores)
    return [ours for ours, _ in measured], [limit for _, limit in measured]


def beside(job: RolloutJob, episodes: int, repeats: int) -> tuple[list[float], list[float]]:
    """Return control steps per second if video may be encoded on another core than simulation
    and rendering.
    """
    ours: list[float] = []
    limits: list[float] = []
    for repeat in range(-1, repeats):
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "demos"
            seconds = record_seconds(Engine(), job, stream_seeds("certificate", episodes), root)
            recorded = [
                read_journal(path)[1] for path in list_episodes(root.with_name("demos.journals"))
            ]
        frames = sum(len(episode) for episode in recorded)
        limit = sum(
            replay_seconds(job, one.seed, one.columns["executed_action"]) for one in recorded
        )
        if repeat >= 0:
            ours.append(frames / seconds)
            limits.append(frames / limit)
    return ours, limits


def steps_per_second(job: RolloutJob, episodes: int) -> tuple[float, float]:
    """Return control steps per second of recording, and of its limit, measured after every
    episode.
    """
    limit = 0.0
    frames = 0

    def replay(path: Path) -> None:
        nonlocal limit, frames
        episode = read_journal(path)[1]
        frames += len(episode)
        limit += replay_seconds(job, episode.seed, episode.columns["executed_action"])

    with tempfile.TemporaryDirectory() as folder:
        seconds = record_seconds(
            Engine(), job, stream_seeds("certificate", episodes), Path(folder) / "demos", replay
        )
    return frames / seconds, frames / limit


def record_seconds(
    engine: Engine,
    job: RolloutJob,
    seeds: range,
    root: Path,
    between: Callable[[Path], None] | None = None,
) -> float:
    """Return the seconds of `manip-il record`'s code path. between: called after every episode,
    not timed.
    """
    journals = root.with_name(f"{root.name}.journals")
    paused = 0.0
    started = time.perf_counter()

    def rollouts() -> Iterator[tuple[Journal, Episode]]:
        nonlocal paused
        for journal, episode in collect(engine, job, seeds, journals):
            yield journal, episode
            if between is not None:
                paused -= time.perf_counter()
                between(episode_path(journals, episode.seed))
                paused += time.perf_counter()

    Recording(provenance=provenance(job)).make(rollouts(), root)
    return time.perf_counter() - started - paused


def replay_seconds(job: RolloutJob, seed: int, actions: np.ndarray) -> float:
    """Return the seconds of an episode's bare physics, and of rendering its pictures if the job
    has cameras.
    """
    import mujoco  # after our import, which chooses the OpenGL backend

    env = LadderEnv(job.env)
    env.start(seed)
    model, data, physics_steps = env.scene.model, env.data, job.env.physics_steps
    space, gripper = env.scene.actions, env.scene.gripper
    commands = [
        np.append(arm, gripper.command(opening)) for arm, opening in map(space.split, actions)
    ]
    controls, order = np.array(commands), [*env.scene.arm_ctrl, *gripper.ctrl]
    if job.cameras is not None:
        pictures(env.scene, data, job.cameras)  # the first call creates the context
    started = time.perf_counter()
    for control in controls:
        if job.cameras is not None:
            pictures(env.scene, data, job.cameras)
        data.ctrl[order] = control
        mujoco.mj_step(model, data, physics_steps)
    return time.perf_counter() - started


def two_workers(name: str, job: RolloutJob, episodes: int, repeats: int) -> None:
    ratios: list[float] = []
    limits: list[float] = []
    with (
        Engine(1) as one,
        Engine(2) as two,
        ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool,
        tempfile.TemporaryDirectory() as folder,
    ):
        for repeat in range(-1, repeats):  # the first one starts the workers
            seeds = stream_seeds("certificate", episodes if repeat >= 0 else 8)
            single, double = (
                record_seconds(engine, job, seeds, Path(folder) / f"{repeat}_{count}")
                for count, engine in enumerate((one, two))
            )
            alone = max(pool.map(bare_seconds, [job]))
            both = max(pool.map(bare_seconds, [job, job]))
            if repeat >= 0:
                ratios.append(single / double)
                limits.append(2 * alone / both)
    print(f"{name:28s}  {spread(ratios):>20s}  {spread(limits):>32s}")


def bare_seconds(job: RolloutJob) -> float:
    """Return the seconds of some bare physics."""
    import mujoco

    env = LadderEnv(job.env)
    env.start(0)
    started = time.perf_counter()
    mujoco.mj_step(env.scene.model, env.data, BARE_STEPS)
    return time.perf_counter() - started


def spread(ratios: list[float]) -> str:
    return f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


if __name__ == "__main__":
    sys.exit(main())
