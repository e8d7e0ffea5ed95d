"""Evaluate policies on given seeds: finished episodes are saved at once, and any episode can be
rerun alone.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.caching import PerThread
from manip_il.collect.job import HOLD, RolloutJob, observed_cameras
from manip_il.collect.workers import Engine
from manip_il.data import schema
from manip_il.data.atomic import append_line, read_lines
from manip_il.errors import MismatchError
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.results import FILE_NAME, EpisodeResult, EvalResult, EvalSettings
from manip_il.mdp import F64, Episode, State
from manip_il.progress import Progress
from manip_il.sim.conditions import NOMINAL, draw, turn_of
from manip_il.sim.world import World
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.several import task_number
from manip_il.worlds.table import described_env, env_fingerprint, env_spec, task_names

CHECK_EVERY = 100  # number of episodes between checks of the interval's width
EPISODES_FILE = "episodes.jsonl"
FOLDER = "evaluations"  # folder for the evaluations of several policies
_world = PerThread(World, 1)


def measure(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    name: str,
    progress: Progress,
    *,
    folder: Path | None = None,
    suite: str = NOMINAL.name,
    until_width: float | None = None,
) -> EvalResult:
    """Run `job` on every seed, to the horizon unless the job has a `hold`.

    Episodes are in the order of `seeds`.

    Args:
        engine: What runs the episodes.
        job: The rollouts.
        seeds: The episodes' seeds.
        name: The policy's name.
        progress: Follows the episodes.
        folder: Where each episode is saved as it ends, and the result at the end. Episodes that
            are there already are not run again, so that an interrupted evaluation can be continued.
        suite: Name of the job's conditions.
        until_width: Stop once the width of the interval is at most this; checked after every
            `CHECK_EVERY` seeds in order, independently of the workers.

    Returns:
        The evaluation.

    Raises:
        MismatchError: if `folder` holds episodes of another job.
    """
    results = finished_episodes(folder, job, suite) if folder else {}
    if folder and (missing := len(set(seeds) - results.keys())):
        progress.start(f"evaluate {name}{'' if suite == NOMINAL.name else f', {suite}'}", missing)
    asked: list[int] = []
    for part in itertools.batched(seeds, CHECK_EVERY if until_width else max(len(seeds), 1)):
        asked += part
        for episode in engine.run(job, [seed for seed in part if seed not in results]):
            result = results[episode.seed] = episode_result(job, episode)
            if folder:
                append_line(folder / EPISODES_FILE, result.to_json())
            progress.episode(result)
        if until_width is not None:
            outcomes = [results[seed].success for seed in asked]
            low, high = Proportion.of(outcomes, sequential=True).interval
            if high - low <= until_width:
                break
    spec = env_spec(job.env)
    found = EvalResult(
        policy=name,
        robot=spec.robot,
        task=spec.task,
        fingerprint=env_fingerprint(job.env, observed_cameras(job)),
        episodes=tuple(results[seed] for seed in asked),
        settings=EvalSettings.of(job, suite),
        policy_sha256=job.policy.sha256 if job.policy is not None else "",
        until_width=until_width,
    )
    if folder:
        progress.close()
        found.write(folder / FILE_NAME)
    return found


def episode_hold(env: EnvConfig, hold: int | None = HOLD) -> int | None:
    """Return the control steps after success at which an episode ends, None if it continues to the
    horizon.

    `hold` does not apply to environments that define this themselves.
    """
    ends = env_spec(env).ends_solved
    return hold if ends is None else 0 if ends else None


def episode_result(job: RolloutJob, episode: Episode) -> EpisodeResult:
    """Return the result of an episode."""
    solved = np.flatnonzero(episode.columns[schema.SUCCESS])
    states = episode.columns[schema.SIM_STATE]
    phase = int(episode.columns[schema.EXPERT_PHASE].ravel()[-1])
    if phase == 0 and episode.success_at_end:  # the expert is not queried in a solved state
        phase = -1
    tasks = task_names(job.env)
    task = str(tasks[task_number(episode.seed, len(tasks))])
    return EpisodeResult(
        seed=episode.seed,
        success=episode.success,
        success_at_end=episode.success_at_end,
        steps=len(episode),
        ret=float(episode.columns[schema.REWARD].sum()),
        phase_at_end=env_spec(job.env).phases[phase],
        detail=({"task": task} if len(tasks) > 1 else {})
        | {
            "steps_to_success": int(solved[0]) + 1 if solved.size else None,
            "condition": turn_of(job.conditions, episode.seed).name,
            "drawn": draw(job.conditions, episode.seed, job.env.object),
            "start": positions(job.env, states[0]),
            "end": positions(job.env, states[-1]),
        },
    )


def positions(env: EnvConfig, sim_state: F64) -> dict[str, list[float]]:
    """Return the true positions [m] of the hand and the objects in one row of `sim_state` (m,):
    name -> [x, y, z].

    The hand is named `hand`. The first object that the arm must reach is named `object`.
    Empty if the environment cannot be restored.
    """
    world = described_env(env)
    if "restored" not in world.spec.can:
        return {}
    world.set_state(State.from_vector(sim_state))
    return {
        name: [round(float(value), 4) for value in at] for name, at in world.positions().items()
    }


def finished_episodes(folder: Path, job: RolloutJob, suite: str) -> dict[int, EpisodeResult]:
    """Return the finished episodes of an evaluation's folder.

    The first line of the episodes' file identifies policy, environment, versions and settings. If
    the file is missing or empty, that line is written.

    Args:
        folder: The folder of the evaluation.
        job: The rollouts that the episodes must be from.
        suite: Name of the job's conditions.

    Returns:
        Seed -> result.

    Raises:
        MismatchError: if the first line differs from that of `job`.
    """
    path = folder / EPISODES_FILE
    common: dict[str, Any] = {
        "policy_sha256": job.policy.sha256 if job.policy is not None else job.driver.name,
        "fingerprint": env_fingerprint(job.env, observed_cameras(job)),
        "settings": EvalSettings.of(job, suite).to_json(),
    }
    records = read_lines(path)
    if not records:
        append_line(path, common)
        return {}
    for key, now in common.items():
        if (before := records[0].get(key)) != now:
            what = f"{key} ({folder} was started with another; --overwrite=true starts over)"
            raise MismatchError(what, "the earlier run", before, "this one", now)
    return {record["seed"]: EpisodeResult.from_json(record) for record in records[1:]}


def replay_differences(before: EpisodeResult, after: EpisodeResult) -> list[str]:
    """Return the differences between two runs of one episode."""
    was, now = before.to_json(), after.to_json()
    compared = ("drawn", "success", "success_at_end", "steps", "return")
    return [
        f"{name} was {was.get(name)}, is {now[name]}"
        for name in compared
        if was.get(name) != now[name]
    ]
