"""Evaluate policies on given seeds: finished episodes are saved at once, and any episode can be rerun alone."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.caching import PerThread
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import HOLD, RolloutJob, observed_cameras
from manip_il.collect.workers import Engine
from manip_il.data import schema
from manip_il.data.json_lines import append_line, read_lines
from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.results import FILE_NAME, EpisodeResult, EvalResult, EvalSettings
from manip_il.mdp import F64, Episode, State
from manip_il.progress import Progress
from manip_il.sim.conditions import NOMINAL, draw, turn_of
from manip_il.sim.task import objects_in
from manip_il.sim.world import World
from manip_il.tasks.config import EnvConfig
from manip_il.tasks.envs import config_scene
from manip_il.tasks.stock.envs import described_stock
from manip_il.tasks.stock.table import ROBOTS as STOCK

_LOG = logging.getLogger(__name__)
CHECK_EVERY = 100  # number of episodes between checks of the interval's width
EPISODES_FILE = "episodes.jsonl"
FOLDER = "evaluations"  # folder for the evaluations of several policies
_world = PerThread(World, 1)


def evaluate(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    name: str,
    on_result: Callable[[EpisodeResult], object] | None = None,
    *,
    suite: str = NOMINAL.name,
    done: Mapping[int, EpisodeResult] | None = None,
    until_width: float | None = None,
) -> EvalResult:
    """Run `job` on every seed, to the horizon unless the job has a `hold`; episodes are in the order of `seeds`.

    suite: name of the job's conditions. done: seed -> result of an earlier run. until_width: stop once the width of the
    interval is at most this; checked after every `CHECK_EVERY` seeds in order, independently of the workers. on_result:
    called with every result as its episode ends. A seed that repeatedly kills its worker is skipped with a warning.
    """
    results: dict[int, EpisodeResult] = {}
    known = done or {}
    for part in itertools.batched(seeds, len(seeds) or 1 if until_width is None else CHECK_EVERY):
        results |= {seed: known[seed] for seed in part if seed in known}
        for episode in engine.run(job, [seed for seed in part if seed not in known]):
            results[episode.seed] = episode_result(job, episode)
            if on_result is not None:
                on_result(results[episode.seed])
        if until_width is not None:
            low, high = Proportion.of([one.success for one in results.values()], sequential=True).interval
            if high - low <= until_width:
                break
    run = [seed for seed in seeds if seed <= max(results, default=-1)] if until_width else seeds
    if lost := [seed for seed in run if seed not in results]:
        _LOG.warning("left out of the evaluation, as each repeatedly killed its worker: seeds %s", lost)
    spec = env_spec(job.env)
    return EvalResult(
        policy=name,
        robot=spec.robot,
        task=spec.task,
        fingerprint=env_fingerprint(job.env, observed_cameras(job)),
        episodes=tuple(results[seed] for seed in seeds if seed in results),
        settings=EvalSettings.of(job, suite),
        policy_sha256=job.policy.sha256 if job.policy is not None else "",
        until_width=until_width,
    )


def episode_hold(env: EnvConfig, hold: int | None = HOLD) -> int | None:
    """Return the control steps after success at which an episode ends, None if it continues to the horizon.

    `hold` does not apply to stock environments, which define this themselves.
    """
    if env.robot not in STOCK:
        return hold
    return 0 if STOCK[env.robot].ends_solved else None


def episode_result(job: RolloutJob, episode: Episode) -> EpisodeResult:
    """Return the result of an episode."""
    solved = episode.columns[schema.SUCCESS].ravel()
    first = int(np.argmax(solved)) + 1 if solved.any() else None
    states = episode.columns[schema.SIM_STATE]
    start, end = (positions(job.env, states[row]) for row in (0, -1))
    drawn = draw(job.conditions, episode.seed, job.env.object)
    phase = int(episode.columns[schema.EXPERT_PHASE].ravel()[-1])
    if phase == 0 and episode.success_at_end:  # the expert is not queried in a solved state
        phase = -1
    return EpisodeResult(
        seed=episode.seed,
        success=episode.success,
        success_at_end=episode.success_at_end,
        steps=len(episode),
        ret=float(episode.columns[schema.REWARD].sum()),
        phase_at_end=env_spec(job.env).phases[phase],
        detail={
            "steps_to_success": first,
            "condition": turn_of(job.conditions, episode.seed).name,
            "drawn": drawn,
            "start": start,
            "end": end,
        },
    )


def positions(env: EnvConfig, sim_state: F64) -> dict[str, list[float]]:
    """Return the true positions [m] of the hand and the objects in one row of `sim_state` (m,): name -> [x, y, z].

    The hand is named `hand`. The first object that the arm must reach is named `object`.
    """
    state = State.from_vector(sim_state)
    if env.robot in STOCK:
        stock = described_stock(env.robot, env.task)
        stock.set_state(state)
        found = stock.positions
    else:
        world = _world(config_scene(env))
        task = world.scene.task
        world.restore(state.physics, state.variation)
        found = {"hand": world.ee.position}
        for name in world.scene.objects:
            found["object" if name in objects_in(task, world)[:1] else name] = world.pose(name).position
    return {name: [round(float(value), 4) for value in at] for name, at in found.items()}


def measure(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    name: str,
    folder: Path,
    progress: Progress,
    *,
    suite: str = NOMINAL.name,
    until_width: float | None = None,
) -> EvalResult:
    """Return a job's evaluation in `folder`, after running the missing episodes; each is saved as it ends.

    Raises what `finished_episodes` raises.
    """
    done = finished_episodes(folder, job, suite)

    def keep(result: EpisodeResult) -> None:
        append_line(folder / EPISODES_FILE, result.to_json())
        progress.episode(result)

    if missing := len(set(seeds) - done.keys()):
        progress.start(f"evaluate {name}{'' if suite == NOMINAL.name else f', {suite}'}", missing)
    result = evaluate(engine, job, seeds, name, keep, suite=suite, done=done, until_width=until_width)
    progress.close()
    result.write(folder / FILE_NAME)
    return result


def finished_episodes(folder: Path, job: RolloutJob, suite: str) -> dict[int, EpisodeResult]:
    """Return seed -> result of the episodes in `folder`. If the episodes' file is missing, write its first line.

    The first line identifies policy, environment, versions and settings. Raises `MismatchError` if they differ from
    those of `job`, `ManipError` for a line that is not an episode.
    """
    path = folder / EPISODES_FILE
    common: dict[str, Any] = {
        "policy_sha256": job.policy.sha256 if job.policy is not None else job.driver.name,
        "fingerprint": env_fingerprint(job.env, observed_cameras(job)),
        "settings": EvalSettings.of(job, suite).to_json(),
    }
    try:
        records = read_lines(path)
        results = [EpisodeResult.from_json(record) for record in records[1:]]
    except (KeyError, TypeError, ValueError, ManipError) as error:
        raise ManipError(f"{path}: a line is not an episode ({error}); start again with --overwrite=true") from error
    if not records:
        append_line(path, common)
        return {}
    for key, now in common.items():
        if (before := records[0].get(key)) != now:
            what = f"{key} ({folder} was started with another; --overwrite=true starts over)"
            raise MismatchError(what, "the earlier run", before, "this one", now)
    return {result.seed: result for result in results}


def replay_differences(before: EpisodeResult, after: EpisodeResult) -> list[str]:
    """Return the differences between two runs of one episode. Raises `MismatchError` if their conditions differ."""
    was, now = before.to_json(), after.to_json()
    drawn = was.get("drawn", {})
    if drawn != now["drawn"]:
        raise MismatchError("what is drawn for the episode", "the file", drawn, "the replay", now["drawn"])
    compared = ("success", "success_at_end", "steps", "return")
    return [f"{name} was {was[name]}, is {now[name]}" for name in compared if was[name] != now[name]]
