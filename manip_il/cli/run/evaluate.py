"""Run `manip-il eval`: how often a policy succeeds on unseen seeds."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

from manip_il.cli.evaluate import EvalOptions
from manip_il.cli.outputs import OutputFile, publish
from manip_il.cli.progress import Stages, say, say_next, warn
from manip_il.cli.run.inputs import open_driver, path_options
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import default_workers
from manip_il.data.atomic import write_file
from manip_il.data.fingerprint import compare_fingerprints, policy_sha256
from manip_il.errors import ManipError, UsageError, shorten
from manip_il.evaluation.eval_report import condition_sides, eval_report, success_table
from manip_il.evaluation.film import film_episode, film_outcomes, run_states
from manip_il.evaluation.policy_folder import find_policy
from manip_il.evaluation.report import Film
from manip_il.evaluation.results import FILE_NAME, EvalResult, merge_results, require_equal
from manip_il.evaluation.runner import episode_hold, episode_result, finished_episodes, measure, replay_differences
from manip_il.evaluation.suites import suite_conditions
from manip_il.seeding import stream_seeds
from manip_il.sim import render
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.worlds.ladder.envs import make_env
from manip_il.worlds.table import env_fingerprint, env_spec

NO_FILES = ("expert", "random")  # drivers without a checkpoint


def run_eval(options: EvalOptions) -> None:
    """Evaluate, write `eval.json` and `report.html`, print the table; or check, replay or merge."""
    match options.evaluation, options.replay:
        case _ if options.health:
            say(f"healthy: {machine()}")
        case [file], int(seed):
            _replay(options, file, seed)
        case [_, _, *_], None:
            _merge(options)
        case [], None if (options.policy.path is None) != (options.policy.type is None):
            _evaluate(options)
        case [], None:
            raise UsageError("give one of --policy.path=DIR and --policy.type=expert|random")
        case _:
            raise UsageError("expected two or more evaluations to merge, or one and --replay=SEED")


def _evaluate(options: EvalOptions) -> None:
    most = 100 if options.until_width is None else 10_000
    end = options.eval.first + (options.eval.n_episodes or most)
    seeds = stream_seeds(options.eval.stream, end, options.seed)[options.eval.first :]
    name, engine = str(options.policy.type or options.policy.path), options.engine.open()
    engine.warm_up(learned=options.policy.path is not None)  # meanwhile this process checks the policy
    job = _job(options)
    with options.output.open(options) as folder:
        finished_episodes(folder, job, options.suite)  # raises if the folder has another policy's episodes
        with Stages(f"finished episodes, in {folder}") as stages, engine:
            result = measure(
                engine, job, seeds, name, folder, stages, suite=options.suite, until_width=options.until_width
            )
            films = film_outcomes(engine, job, result, options.eval.films, stages)
        _report(options, result, folder, *films)
    seed = next((one.seed for one in result.episodes if not one.success), result.episodes[0].seed)
    policy = [] if options.policy.path is None else [f"--policy.path={options.policy.path}"]
    say_next("eval", folder, *policy, *path_options(job.env), f"--replay={seed}", "--video=replay.mp4")


def _job(options: EvalOptions) -> RolloutJob:
    policy, kind = options.policy, options.policy.type or "expert"
    env, driver, cameras = open_driver(policy.path, kind, options.env, trust=options.trust, device=policy.device)
    conditions = suite_conditions(options.suite, env, sees=cameras is not None)
    hold = episode_hold(env, options.eval.hold)
    return RolloutJob(env, driver, hold, label="last", conditions=conditions, batch=options.eval.batch_size)


def _report(
    options: EvalOptions, result: EvalResult, folder: Path, films: Sequence[Film] = (), no_films: str = ""
) -> None:
    """Write the result and its report, and print its tables."""
    page = eval_report(result, films, no_films)
    publish(folder / FILE_NAME, result.to_json(), [success_table(condition_sides(result))], page=page, options=options)


def _merge(options: EvalOptions) -> None:
    """Merge evaluations; warn if they were made with different versions or models."""
    parts = {str(path): EvalResult.read(path) for path in options.evaluation}
    merged, ((first, one), *others) = merge_results(parts), parts.items()
    for name, other in others:
        warn(*compare_fingerprints(first, dict(one.fingerprint), name, dict(other.fingerprint)))
    with options.output.open(options) as folder:
        _report(options, merged, folder)


def _replay(options: EvalOptions, file: Path, seed: int) -> None:
    """Replay one episode with the same policy, seed and conditions; `ManipError` if its outcome differs."""
    if options.video is not None:
        OutputFile(options.video, overwrite=options.output.overwrite).check()
    result = EvalResult.read(file)
    by_seed = {episode.seed: episode for episode in result.episodes}
    if seed not in by_seed:
        raise UsageError(f"--replay is {seed}; {file} has seeds {min(by_seed)} to {max(by_seed)}")
    before, job = by_seed[seed], _job_of(options, result, file)
    episode = run_states(job, seed)
    ended = "success" if before.success else f"failure in phase {before.phase_at_end}"
    say(f"seed {seed}, {before.detail.get('condition', 'nominal')}: {ended}")
    say(*(f"  {name}: {json.dumps(value)}" for name, value in before.detail.get("drawn", {}).items()))
    if options.video is not None:
        write_file(options.video, film_episode(job.env, episode).mp4)
        say(f"video: {options.video}")
    if differences := replay_differences(before, episode_result(job, episode)):
        raise ManipError(
            f"the episode of seed {seed} differs from {file}: {'; '.join(differences)}; compare success rates, "
            "not single episodes, across machines and versions"
        )
    say(f"the same as in {file}")


def _job_of(options: EvalOptions, result: EvalResult, file: Path) -> RolloutJob:
    """Return the rollout job of an evaluation; warn if the policy or this program has changed since.

    The policy, and a robot, a task or a mesh of the user's own, must be given again: no path in the file is opened.
    """
    settings, own = result.settings, options.env
    env = result.env(own["robot"], own["task"], own["object"])
    require_equal(str(file), result, "what is given", env_spec(env), "robot", "task")
    if options.policy.path is None and result.policy not in NO_FILES:
        raise UsageError(f"{file} evaluates the policy {shorten(result.policy)}; give that with --policy.path=DIR")
    path = None if options.policy.path is None else find_policy(options.policy.path)
    _, driver, cameras = open_driver(path, result.policy, env, trust=options.trust)
    if path is not None and result.policy_sha256 not in ("", policy_sha256(path)):
        warn(f"{path} is not the policy of {file}: its files differ")
    here = env_fingerprint(env, cameras)
    warn(*compare_fingerprints(str(file), dict(result.fingerprint), "this machine", here))
    return RolloutJob(env, driver, settings.hold, label="last", conditions=settings.conditions)


def machine() -> str:
    """Return the OpenGL renderer and the number of cores. Raises if an environment cannot start or render here."""
    tempfile.TemporaryFile().close()  # workers need a folder for temporary files
    env = make_env()
    env.start(0)
    render.pictures(env.scene, env.data, CameraConfig(CAMERAS))
    from OpenGL import GL  # imported after mujoco has set PYOPENGL_PLATFORM

    renderer = GL.glGetString(GL.GL_RENDERER) or b"unknown renderer"
    return f"{renderer.decode()}; cores {default_workers()}"
