"""Run `manip-il eval`: how often a policy succeeds on unseen seeds."""

import json
import tempfile
from pathlib import Path

from manip_il.cli.evaluate import EvalOptions
from manip_il.cli.outputs import OutputFile, Stages, about, say, say_next
from manip_il.collect.inputs import path_options
from manip_il.collect.workers import default_workers
from manip_il.data.atomic import write_file
from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.eval_report import condition_sides, success_table
from manip_il.evaluation.film import film_episode
from manip_il.evaluation.measuring import evaluate, replay
from manip_il.evaluation.report import REPORT_FILE
from manip_il.evaluation.results import FILE_NAME
from manip_il.sim import render
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.worlds.ladder.world import make_env


def run_eval(options: EvalOptions) -> None:
    """Evaluate, write `eval.json` and `report.html`, print the table; or check, or replay."""
    match options.evaluation, options.replay:
        case _ if options.health:
            say(f"healthy: {machine()}")
        case Path() as file, int(seed):
            _replay(options, file, seed)
        case None, None if (options.policy.path is None) != (options.policy.type is None):
            _evaluate(options)
        case None, None:
            raise UsageError("give one of --policy.path=DIR and --policy.type=expert|random")
        case _:
            raise UsageError("EVALUATION and --replay=SEED belong together; give both")


def _evaluate(options: EvalOptions) -> None:
    folder = options.output_dir
    policy, how = options.policy, options.eval
    with (
        options.lock() as prepare,
        Stages(f"finished episodes, in {folder}", prepare) as stages,
        options.open_engine() as engine,
    ):
        result = evaluate(
            policy.path,
            options.env,
            how.n_episodes,
            kind=policy.type or "expert",
            suite=options.suite,
            stream=how.stream,
            seed=options.seed,
            hold=how.hold,
            until_width=options.until_width,
            output_dir=folder,
            films=how.films,
            about=about(options),
            workers=engine,
            trust=options.trust,
            device=policy.device,
            progress=stages,
            batch=how.batch_size,
        )
    success_table(condition_sides(result)).print()
    say(f"result: {folder / FILE_NAME}", f"report: {folder / REPORT_FILE}")
    seed = next((one.seed for one in result.episodes if not one.success), result.episodes[0].seed)
    words = [] if policy.path is None else [f"--policy.path={policy.path}"]
    words += path_options(options.env)
    say_next("eval", folder, *words, f"--replay={seed}", "--video=replay.mp4")


def _replay(options: EvalOptions, file: Path, seed: int) -> None:
    """Replay one episode with the same policy, seed and conditions.

    `ManipError` if its outcome differs.
    """
    if options.video is not None:
        OutputFile(output=options.video, overwrite=options.overwrite).check()
    own = {name: options.env[name] for name in ("robot", "task", "object")}
    again = replay(file, seed, options.policy.path, **own, trust=options.trust)
    before = again.before
    ended = "success" if before.success else f"failure in phase {before.phase_at_end}"
    say(f"seed {seed}, {before.condition or 'nominal'}: {ended}")
    say(
        *(
            f"  {name}: {json.dumps(value)}"
            for name, value in before.detail.get("drawn", {}).items()
        )
    )
    if options.video is not None:
        write_file(options.video, film_episode(again.job.env, again.episode).mp4)
        say(f"video: {options.video}")
    if again.differences:
        raise ManipError(
            f"the episode of seed {seed} differs from {file}: {'; '.join(again.differences)};"
            " compare success rates, not single episodes, across machines and versions"
        )
    say(f"the same as in {file}")


def machine() -> str:
    """Return the OpenGL renderer and the number of cores.

    Raises if an environment cannot start or render here.
    """
    tempfile.TemporaryFile().close()  # workers need a folder for temporary files
    env = make_env()
    env.start(0)
    render.pictures(env.scene, env.data, CameraConfig(CAMERAS))
    from OpenGL import GL  # imported after mujoco has set PYOPENGL_PLATFORM

    renderer = GL.glGetString(GL.GL_RENDERER) or b"unknown renderer"
    return f"{renderer.decode()}; cores {default_workers()}"
