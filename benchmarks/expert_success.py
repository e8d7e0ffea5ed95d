"""How often the expert succeeds: from fresh starts, from disturbed states, and under action noise.

python benchmarks/expert_success.py [--seeds N] [--cases N] [--quick]

Shares with Wilson's 95 % intervals, on the seeds of the `certificate` stream. A disturbed case runs to a drawn step
of 3 to 25, is disturbed there, and has a whole horizon from then on; success counts from there.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context

import numpy as np
from _machine import describe_machine

from manip_il.engine.engine import Engine, default_workers
from manip_il.engine.jobs import RolloutJob
from manip_il.evaluation.statistics import Proportion
from manip_il.expert.expert import Expert
from manip_il.mdp import Episode
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.disturb import Disturbance, drop_object, jolt_joints, knock_object, set_fingers
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.robot import ROBOTS
from manip_il.sim.task import TASKS

FIRST_STEP, LAST_STEP = 3, 25
NOISE = 0.1  # standard deviation, as a share of the action's range
SHOWN = 8  # seeds of failures in a line at most


def _knock(env: ManipEnv, rng: np.random.Generator) -> bool:
    return knock_object(env, rng, (0.0, 0.1))


def _drop(env: ManipEnv, rng: np.random.Generator) -> bool:
    return drop_object(env, rng, (0.0, 0.1), 0.1)


def _jolt(env: ManipEnv, rng: np.random.Generator) -> bool:
    return jolt_joints(env, rng, 0.2)


def _close(env: ManipEnv, rng: np.random.Generator) -> bool:
    set_fingers(env, 0.0)
    return True


def _open(env: ManipEnv, rng: np.random.Generator) -> bool:
    set_fingers(env, env.scene.robot.max_opening)
    return True


KINDS: dict[str, Callable[[ManipEnv, np.random.Generator], bool]] = {
    "joints off by up to 0.2 rad": _jolt,
    "object moved up to 10 cm": _knock,
    "object dropped from 10 cm": _drop,
    "gripper wrongly closed": _close,
    "gripper wrongly open": _open,
}


@dataclass(frozen=True)
class Case:
    """One seed and what happened: the disturbance found a place, the task was solved within a horizon after it."""

    seed: int
    disturbed: bool
    success: bool


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1_000, help="fresh starts for each robot and task")
    parser.add_argument("--cases", type=int, default=500, help="disturbed cases for each robot, over all kinds")
    parser.add_argument("--quick", action="store_true", help="few seeds: shows that it runs, certifies nothing")
    options = parser.parse_args()
    starts, cases = (20, 20) if options.quick else (options.seeds, options.cases)
    started = time.monotonic()
    print(describe_machine())
    print(f"{'robot':6s}  {'from':34s}  {'success [95 %]':26s}  failed seeds")
    workers = default_workers()
    with Engine(workers) as engine, ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for robot in ROBOTS:
            for task in TASKS:
                row(robot, task, fresh(engine, RolloutJob(EnvConfig(robot, task), "expert", hold=0), starts))
            each = max(1, cases // len(KINDS))
            everything: list[Case] = []
            for kind in KINDS:
                found = list(pool.map(partial(disturbed, robot, kind), stream_seeds("certificate", each), chunksize=5))
                everything += found
                row(robot, kind, found)
            row(robot, "all disturbed states", everything)
            for task in TASKS:
                noisy = RolloutJob(EnvConfig(robot, task), "expert", hold=0, disturbance=Disturbance(NOISE))
                row(robot, f"{task}, {NOISE:.0%} action noise", fresh(engine, noisy, max(1, starts // 5)))
    print(f"{time.monotonic() - started:.0f} s on {workers} processes")
    return 0


def fresh(engine: Engine, job: RolloutJob, count: int) -> list[Case]:
    """Whole episodes of the expert, ended at success."""
    episodes: Iterable[Episode] = engine.run(job, stream_seeds("certificate", count))
    return sorted((Case(e.seed, True, e.success) for e in episodes), key=lambda case: case.seed)


def disturbed(robot: str, kind: str, seed: int) -> Case:
    """One pick-and-place episode, disturbed at a drawn step; one process's work."""
    env, expert = _env(robot)
    rng = rng_for(seed, f"certificate of {kind}")
    at = int(rng.integers(FIRST_STEP, LAST_STEP + 1))
    env.start(seed)
    for _ in range(at):
        env.advance(expert.label(env.get_state()).action)
    happened = KINDS[kind](env, rng)
    env.set_state(replace(env.get_state(), streak=0))  # what was solved before does not count
    for _ in range(env.config.horizon):
        env.advance(expert.label(env.get_state()).action)
        if env.solved:
            return Case(seed, happened, True)
    return Case(seed, happened, False)


@cache
def _env(robot: str) -> tuple[ManipEnv, Expert]:
    env = ManipEnv(robot, "pick_place")
    return env, Expert(env.scene)


def row(robot: str, what: str, cases: list[Case]) -> None:
    """One line; a case whose disturbance found no place is said, not counted."""
    counted = [case for case in cases if case.disturbed]
    if not counted:
        print(f"{robot:6s}  {what:34s}  no place for it in {len(cases)} cases")
        return
    success = Proportion.of([case.success for case in counted])
    failed = [str(case.seed) for case in counted if not case.success]
    more = f" and {len(failed) - SHOWN} more" if len(failed) > SHOWN else ""
    left_out = f" ({len(cases) - len(counted)} without a place left out)" if len(counted) < len(cases) else ""
    rate = f"{success.successes}/{success.n} {success}"
    print(f"{robot:6s}  {what:34s}  {rate:26s}  {' '.join(failed[:SHOWN])}{more}{left_out}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
