"""Recording from end to end (simulate, label, journal, dataset) against what its parts cost alone, in the same run.

python benchmarks/recording_speed.py [--quick]

One core: this process is held on one core, threads that encode video included. The limit is `mj_step` replaying the
recorded controls from the same starts; with cameras, that and drawing the same pictures. Two workers: the same
recording with two processes against one, both warm. By turns in the same run; the median ratio counts.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from _machine import describe_machine

from manip_il.dagger.collect import collect, provenance, record
from manip_il.data.build import Recording
from manip_il.data.journal import read_episode
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.look import CameraConfig
from manip_il.sim.render import pictures
from manip_il.sim.robot import ROBOTS

HOLD = 10  # as `manip-il record`
CAMERAS = CameraConfig(("front", "wrist"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few episodes: shows that it runs, measures little")
    quick = parser.parse_args().quick
    print(describe_machine())
    print("recording                       control steps/s  limit, control steps/s  share (median, all repeats)")
    for robot in ROBOTS:
        job = RolloutJob(EnvConfig(robot), "expert", beta=1.0, hold=HOLD)
        report(f"{robot}, one core", *one_core(job, 2 if quick else 40, 2 if quick else 5))
    for robot in ROBOTS:
        job = RolloutJob(EnvConfig(robot), "expert", beta=1.0, hold=HOLD, cameras=CAMERAS)
        report(f"{robot}, two cameras, one core", *one_core(job, 1 if quick else 6, 2 if quick else 5))
    print("recording                     one worker, episodes/s  two workers, episodes/s  ratio (median, all repeats)")
    for robot in ROBOTS:
        job = RolloutJob(EnvConfig(robot), "expert", beta=1.0, hold=HOLD)
        two_workers(robot, job, 8 if quick else 100, 2 if quick else 5)
    return 0


def report(name: str, ours: list[float], limits: list[float]) -> None:
    shares = [one / limit for one, limit in zip(ours, limits, strict=True)]
    spread = f"{min(shares):.2f} to {max(shares):.2f}"
    rates = f"{statistics.median(ours):15,.0f}  {statistics.median(limits):22,.0f}"
    print(f"{name:30s}  {rates}  {statistics.median(shares):.2f} ({spread})")


def one_core(job: RolloutJob, episodes: int, repeats: int) -> tuple[list[float], list[float]]:
    """Control steps a second on one core: recording, and its limit."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        measured = [steps_per_second(job, episodes) for _ in range(repeats + 1)][1:]  # the first loads and compiles
    finally:
        os.sched_setaffinity(0, cores)
    return [ours for ours, _ in measured], [limit for _, limit in measured]


def steps_per_second(job: RolloutJob, episodes: int) -> tuple[float, float]:
    seeds = stream_seeds("certificate", episodes)
    with tempfile.TemporaryDirectory() as folder:
        journals = Path(folder) / "demos.journals"
        seconds, paths = record_seconds(Engine(), job, seeds, Path(folder) / "demos")
        recorded = [read_episode(path).without_pictures() for path in paths]
        assert journals.is_dir()
    frames = sum(len(episode) for episode in recorded)
    limit = sum(replay_seconds(job, episode.seed, episode.columns["executed_action"]) for episode in recorded)
    return frames / seconds, frames / limit


def record_seconds(engine: Engine, job: RolloutJob, seeds: range, root: Path) -> tuple[float, list[Path]]:
    journals = root.with_name(f"{root.name}.journals")
    paths: list[Path] = []

    def episodes():
        for path in collect(engine, job, seeds, journals):
            paths.append(path)
            yield path

    started = time.perf_counter()
    record(episodes(), journals, root, job, Recording("local/x", provenance=provenance(job)))
    return time.perf_counter() - started, paths


def replay_seconds(job: RolloutJob, seed: int, actions: np.ndarray) -> float:
    """Seconds of the bare physics of an episode, and of its pictures where the job makes some."""
    import mujoco  # after ours, which chooses its OpenGL

    env = ManipEnv(config=job.env)
    env.start(seed)
    model, data, physics_steps = env.scene.model, env.data, job.env.physics_steps
    controls = np.concatenate([actions, actions[:, -1:] / 2], axis=1).astype(np.float64)
    controls[:, -2] /= 2  # the command is the opening; each finger goes half of it
    order = [*env.scene.arm_ctrl, *env.scene.finger_ctrl]
    if job.cameras is not None:
        pictures(job.env.robot, job.env.task, data, job.cameras)  # the first makes the context
    started = time.perf_counter()
    for control in controls:
        if job.cameras is not None:
            pictures(job.env.robot, job.env.task, data, job.cameras)
        data.ctrl[order] = control
        mujoco.mj_step(model, data, physics_steps)
    return time.perf_counter() - started


def two_workers(name: str, job: RolloutJob, episodes: int, repeats: int) -> None:
    rates: dict[int, list[float]] = {1: [], 2: []}
    with Engine(1) as one, Engine(2) as two, tempfile.TemporaryDirectory() as folder:
        for repeat in range(-1, repeats):  # the first starts the workers
            for engine, workers in ((one, 1), (two, 2)):
                seeds = stream_seeds("certificate", episodes if repeat >= 0 else 8)
                seconds, _ = record_seconds(engine, job, seeds, Path(folder) / f"{repeat}_{workers}")
                if repeat >= 0:
                    rates[workers].append(episodes / seconds)
    ratios = [double / single for single, double in zip(rates[1], rates[2], strict=True)]
    row = f"{statistics.median(rates[1]):22.1f}  {statistics.median(rates[2]):23.1f}"
    print(f"{name:28s}  {row}  {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")


if __name__ == "__main__":
    sys.exit(main())
