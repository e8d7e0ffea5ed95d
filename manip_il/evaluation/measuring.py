"""Evaluate policies on given seeds.

Finished episodes are saved at once, and any episode can be run again alone.
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from manip_il import checks
from manip_il.caching import PerThread
from manip_il.collect.drivers import Driver, PolicyDriver, driver_of
from manip_il.collect.inputs import check_policy, env_config
from manip_il.collect.job import HOLD, RolloutJob, observed_cameras
from manip_il.collect.workers import Engine, engine_of
from manip_il.data import schema
from manip_il.data.atomic import append_line, read_lines
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.errors import MismatchError, UsageError, shorten, warn
from manip_il.evaluation.eval_report import eval_report
from manip_il.evaluation.film import film_outcomes
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.results import (
    FILE_NAME,
    EpisodeResult,
    EvalResult,
    EvalSettings,
    require_equal,
)
from manip_il.evaluation.side import Side
from manip_il.evaluation.suites import suite_conditions
from manip_il.learn.checkpoint import Checkpoint
from manip_il.mdp import Episode
from manip_il.option import NameOrPath, make_options
from manip_il.progress import Progress
from manip_il.seeding import BLOCK, stream_seeds
from manip_il.sim.conditions import NOMINAL, draw, turn_of
from manip_il.sim.config import CameraConfig
from manip_il.sim.world import World
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.several import task_number
from manip_il.worlds.table import env_fingerprint, env_of_name, env_spec, task_names

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
        },
    )


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


_MOST_UNTIL_WIDTH = 10_000  # episodes, if their number is not given
_NO_FILES = ("expert", "random")  # drivers without a checkpoint
Env = EnvConfig | str | Mapping[str, Any]


def evaluate(
    policy: Any = None,
    env: Env | None = None,
    episodes: int | None = None,
    *,
    kind: str = "expert",
    suite: str = "",
    stream: Literal["test", "validation"] = "test",
    seed: int = 0,
    hold: int | None = HOLD,
    until_width: float | None = None,
    output_dir: Path | None = None,
    films: int = 0,
    about: Mapping[str, Any] | None = None,
    workers: int | Engine | None = 1,
    trust: bool = False,
    device: str = "cpu",
    progress: Progress | None = None,
    **options: Any,
) -> EvalResult:
    """Evaluate a policy, by default the expert, on unseen seeds.

    Args:
        policy: A `Checkpoint`, or the path of a checkpoint or a run.
        env: The environment, its name, or those of its settings that differ from the policy's
            training environment.
        episodes: Number of episodes, by default 100; at most 10,000 with `until_width`.
        kind: Who drives without a policy: expert or random.
        suite: Test conditions, by default nominal; or only their name, if `conditions` is among the
            options.
        stream: Which stream of seeds.
        seed: 0 to 1000.
        hold: Control steps after success until an episode ends; None: it ends at the horizon.
        until_width: Stop when the confidence interval is this narrow.
        output_dir: Folder for `eval.json` and the finished episodes, which are not run again.
        films: Number of failures to film for the report, and of successes.
        about: Further fields of the report, `report.html` in the folder; None for no report.
        workers: Number of processes, None for one per core; or the engine to use.
        trust: Whether to load models and code that the checkpoint names.
        device: Where the policy runs.
        progress: Follows the evaluation.
        options: Fields of `RolloutJob`, such as `conditions`.

    Returns:
        The outcome of every episode.

    Raises:
        UsageError: if neither `env` nor the policy names an environment.
        MismatchError: if the policy does not fit `env`, or the folder holds another evaluation.
    """
    progress = progress or Progress()
    with engine_of(workers) as engine:
        engine.warm_up(learned=policy is not None)  # meanwhile this process checks the policy
        env, driver, cameras = open_driver(policy, env, kind, trust=trust, device=device)
        if "conditions" not in options:
            suite = suite or NOMINAL.name
            options["conditions"] = suite_conditions(suite, env, sees=cameras is not None)
        suite = suite or "_".join(one.name for one in options["conditions"])
        chosen: dict[str, Any] = {"hold": episode_hold(env, hold), "label": "last"}
        job = make_options(RolloutJob, env=env, driver=driver, **chosen | options)
        most = 100 if until_width is None else _MOST_UNTIL_WIDTH
        count = checks.whole("episodes", most if episodes is None else episodes, 1, BLOCK)
        seeds = stream_seeds(stream, count, seed)
        name = kind if policy is None else str(getattr(policy, "path", policy))
        progress.started()
        result = measure(
            engine,
            job,
            seeds,
            name,
            progress,
            folder=output_dir,
            suite=suite,
            until_width=until_width,
        )
        made = film_outcomes(engine, job, result, films, progress)
    if output_dir is not None and about is not None:
        replace(eval_report(result, made), **about).write(output_dir)
    return result


def measure_sides(
    sides: Sequence[Side],
    envs: Mapping[str, EnvConfig],
    folder: Path,
    *,
    episodes: int,
    suite: str,
    seed: int = 0,
    trust: bool = False,
    engine: Engine,
    progress: Progress,
) -> tuple[Side, ...]:
    """Evaluate the policies of a comparison on the same seeds.

    Finished episodes in the folder are not run again.

    Args:
        sides: The sides; their members have policies.
        envs: Name of a side -> its environment.
        folder: Folder for the evaluations.
        episodes: Number of test episodes.
        suite: Test conditions; those on cameras count only if some policy uses cameras.
        seed: 0 to 1000.
        trust: Whether to load models and code that a checkpoint names.
        engine: Runs the episodes.
        progress: Follows the evaluations.

    Returns:
        The sides, with the results of their members.

    Raises:
        MismatchError: before any episode runs, if a policy does not fit its environment.
    """
    members = [(envs[side.name], member) for side in sides for member in side.members]
    drivers = [open_driver(member.policy, env, trust=trust) for env, member in members]
    sees = any(cameras for *_, cameras in drivers)
    seeds = stream_seeds("test", episodes, seed)
    results = list[EvalResult]()
    progress.started()
    for (env, driver, _), (_, member) in zip(drivers, members, strict=True):
        conditions = suite_conditions(suite, env, sees=sees)
        job = RolloutJob(env, driver, episode_hold(env), label="last", conditions=conditions)
        digest = job.policy.sha256[:8] if job.policy else driver.name
        words = f"{re.sub(r'[^A-Za-z0-9]+', '_', member.name)[-80:]}_{digest}"
        results.append(
            measure(
                engine,
                job,
                seeds,
                member.name,
                progress,
                folder=folder / FOLDER / words,
                suite=suite,
            )
        )
    found = iter(results)
    return tuple(
        replace(side, members=tuple(replace(member, result=next(found)) for member in side.members))
        for side in sides
    )


def open_driver(
    policy: Any, env: Env | None, kind: str = "expert", *, trust: bool = False, device: str = "cpu"
) -> tuple[EnvConfig, Driver, CameraConfig | None]:
    """Open what drives an evaluation, and check that it can drive the environment.

    Args:
        policy: A `Checkpoint`, or the path of a checkpoint or a run; None for no policy.
        env: The environment, its name, or those of its settings that differ from the policy's
            training environment.
        kind: Who drives without a policy: expert or random.
        trust: Whether to load models and code that the checkpoint names.
        device: Where the policy computes, such as `cpu` or `cuda`.

    Returns:
        The environment, the driver, and the cameras whose pictures the driver takes, None if it
        takes none.

    Raises:
        UsageError: if `env` is missing and the policy does not name one.
        MismatchError: if the policy cannot drive the environment.
        ManipError: if loading the policy needs `trust`.
    """
    checkpoint = None if policy is None else Checkpoint.of(policy)
    origin = checkpoint.origin if checkpoint else None
    if env is None and origin is None:
        raise UsageError("env is missing, and the policy does not name one")
    env = (
        env_config(env or {}, origin)
        if env is None or isinstance(env, Mapping)
        else env_of_name(env)
    )
    if checkpoint is None:
        return env, driver_of(kind), None
    check_policy(checkpoint, env, trust=trust)
    return env, PolicyDriver((checkpoint,), trust=trust, device=device), checkpoint.cameras


@dataclass(frozen=True)
class Replay:
    """An episode of an evaluation that was run again.

    Attributes:
        before: The episode's result in the evaluation.
        job: What was run again.
        episode: The episode of this run.
        differences: Differences between both runs, in words; empty if there are none.
    """

    before: EpisodeResult
    job: RolloutJob
    episode: Episode
    differences: list[str]


def replay(
    file: Path,
    seed: int,
    policy: Path | None = None,
    *,
    robot: NameOrPath | None = None,
    task: NameOrPath | None = None,
    object: NameOrPath | None = None,
    trust: bool = False,
) -> Replay:
    """Run one episode of an evaluation again; warn if the policy or this program has changed since.

    The policy, and a robot, a task or a mesh of the user's own, must be given again: no path in the
    file is opened.

    Args:
        file: The `eval.json` or its folder.
        seed: Seed of the episode.
        policy: The policy of the evaluation.
        robot: The user's own robot.
        task: The user's own task.
        object: The user's own mesh.
        trust: Whether to load models and code that the checkpoint names.

    Returns:
        Both runs of the episode.

    Raises:
        UsageError: if the evaluation has no such seed, or its policy is not given.
        MismatchError: if what is given has another robot or task.
    """
    result = EvalResult.read(file)
    by_seed = {episode.seed: episode for episode in result.episodes}
    if seed not in by_seed:
        raise UsageError(f"--replay is {seed}; {file} has seeds {min(by_seed)} to {max(by_seed)}")
    env = result.env(robot, task, object)
    require_equal(str(file), result, "what is given", env_spec(env), "robot", "task")
    if policy is None and result.policy not in _NO_FILES:
        raise UsageError(
            f"{file} evaluates the policy {shorten(result.policy)}; give that with"
            " --policy.path=DIR"
        )
    _, driver, _ = open_driver(policy, env, result.policy, trust=trust)
    settings = result.settings
    job = RolloutJob(env, driver, settings.hold, label="last", conditions=settings.conditions)
    if job.policy is not None and result.policy_sha256 not in ("", job.policy.sha256):
        warn(f"{policy} is not the policy of {file}: its files differ")
    here = env_fingerprint(env, observed_cameras(job))
    warn(*compare_fingerprints(str(file), dict(result.fingerprint), "this machine", here))
    [episode] = job.run([seed])
    return Replay(
        by_seed[seed], job, episode, replay_differences(by_seed[seed], episode_result(job, episode))
    )
