"""`manip-il eval`: how often a policy succeeds on unseen seeds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli.common_options import OF_POLICY, EngineOptions, Tested, Trusting, path_options
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import OutputFile, ResumableOutput, publish
from manip_il.cli.progress import Stages, say, say_next, warn
from manip_il.data.atomic import write_file
from manip_il.errors import ManipError, UsageError, shorten
from manip_il.option import Seeded, option
from manip_il.tasks.config import EnvConfig

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.evaluation.report import Film
    from manip_il.evaluation.results import EvalResult

EPISODES, MOST_EPISODES = 100, 10_000
NO_FILES = ("expert", "random")  # drivers without a checkpoint


@dataclass(frozen=True)
class MeasuredPolicyGroup:
    """`--policy.*`: the policy to evaluate."""

    path: Path | None = option(None, "a checkpoint or a run")
    type: Literal["expert", "random"] | None = option(None, "who drives instead of a checkpoint")
    device: str = option("cpu", "where the policy runs: cpu or cuda")


@dataclass(frozen=True)
class EvalGroup:
    """`--eval.*`: the episodes to run."""

    n_episodes: int | None = option(
        None, "test episodes; by default 100, or up to 10,000 with --until_width", at_least=1, grows=True
    )
    first: int = option(0, "index of the first seed in the stream, to run a large evaluation in parts", at_least=0)
    hold: int | None = option(
        10, "control steps after success until an episode ends; null: it ends at the horizon", at_least=0
    )
    batch_size: int = option(
        25, "episodes that run in lockstep and share policy calls; does not change results", at_least=1, free=True
    )
    stream: Literal["test", "validation"] = option("test", "which stream of seeds; no policy is selected on test seeds")
    films: int = option(2, "number of failures to film, and of successes", at_least=0, free=True)


@dataclass(frozen=True)
class EvalOptions(Tested, Seeded, Trusting):
    """Measure a policy's success on unseen seeds; writes eval.json and report.html.

    With EVALUATION, an eval.json or its folder, no policy is evaluated: --replay=SEED runs one of its episodes again
    and films it; two or more, such as parts run on several machines, are merged. --check renders a picture and reports
    whether this machine or container can evaluate.
    """

    example: ClassVar[str] = "manip-il eval --policy.type=expert --eval.n_episodes=200 --output_dir=runs/expert"
    first: ClassVar[str] = "policy.path policy.type eval.n_episodes suite robot.type task.type output_dir replay resume"
    evaluation: list[Path] = option(
        list, "evaluations: one with --replay, or several to merge", positional=True, exists=""
    )
    policy: MeasuredPolicyGroup = field(default_factory=MeasuredPolicyGroup)
    env: Given = given(EnvConfig, **OF_POLICY)
    eval: EvalGroup = field(default_factory=EvalGroup)
    until_width: float | None = option(
        None, "stop when the confidence interval is this narrow; 0.02: 2 percentage points", at_least=0.0001, at_most=1
    )
    engine: EngineOptions = group(EngineOptions(), prefix="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/eval")), prefix="")
    replay: int | None = option(None, "seed of the episode of EVALUATION to replay", at_least=0, free=True)
    video: Path | None = option(None, "MP4 file for the replay", free=True)
    health: bool = option(False, "check that this machine can evaluate and render", flag="check", free=True)

    def run(self) -> None:
        """Evaluate, write `eval.json` and `report.html`, print the table; or check, replay or merge."""
        match self.evaluation, self.replay:
            case _ if self.health:
                say(f"healthy: {machine()}")
            case [file], int(seed):
                self._replay(file, seed)
            case [_, _, *_], None:
                self._merge()
            case [], None if (self.policy.path is None) != (self.policy.type is None):
                self._evaluate()
            case [], None:
                raise UsageError("give one of --policy.path=DIR and --policy.type=expert|random")
            case _:
                raise UsageError("expected two or more evaluations to merge, or one and --replay=SEED")

    def _evaluate(self) -> None:
        from manip_il.evaluation.film import film_outcomes
        from manip_il.evaluation.runner import finished_episodes, measure
        from manip_il.seeding import stream_seeds

        most = EPISODES if self.until_width is None else MOST_EPISODES
        end = self.eval.first + (self.eval.n_episodes or most)
        seeds = stream_seeds(self.eval.stream, end, self.seed)[self.eval.first :]
        name, engine = str(self.policy.type or self.policy.path), self.engine.open()
        engine.warm_up(learned=self.policy.path is not None)  # meanwhile this process checks the policy
        job = self._job()
        suite = self.suite
        width = self.until_width
        with self.output.open(self) as folder:
            finished_episodes(folder, job, suite)  # raises if the folder has another policy's episodes
            with Stages(f"finished episodes, in {folder}") as stages, engine:
                result = measure(engine, job, seeds, name, folder, stages, suite=suite, until_width=width)
                films = film_outcomes(engine, job, result, self.eval.films, stages)
            self._report(result, folder, *films)
        seed = next((one.seed for one in result.episodes if not one.success), result.episodes[0].seed)
        policy = [] if self.policy.path is None else [f"--policy.path={self.policy.path}"]
        say_next("eval", folder, *policy, *path_options(job.env), f"--replay={seed}", "--video=replay.mp4")

    def _job(self) -> RolloutJob:
        from manip_il.cli.inputs import open_driver
        from manip_il.collect.job import RolloutJob
        from manip_il.evaluation.runner import episode_hold
        from manip_il.evaluation.suites import suite_conditions

        kind, device = self.policy.type or "expert", self.policy.device
        env, driver, cameras = open_driver(self.policy.path, kind, self.env, trust=self.trust, device=device)
        conditions = suite_conditions(self.suite, env, sees=cameras is not None)
        hold, batch = episode_hold(env, self.eval.hold), self.eval.batch_size
        return RolloutJob(env, driver, hold, label="last", conditions=conditions, batch=batch)

    def _report(self, result: EvalResult, folder: Path, films: Sequence[Film] = (), no_films: str = "") -> None:
        """Write the result and its report, and print its tables."""
        from manip_il.evaluation.eval_report import condition_sides, eval_report, success_table
        from manip_il.evaluation.results import FILE_NAME

        page = eval_report(result, command_line(), to_plain(self), films, no_films)
        publish(folder / FILE_NAME, result.to_json(), [success_table(condition_sides(result))], page=page)

    def _merge(self) -> None:
        """Merge evaluations; warn if they were made with different versions or models."""
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.evaluation.results import EvalResult, merge_results

        parts = {str(path): EvalResult.read(path) for path in self.evaluation}
        merged, ((first, one), *others) = merge_results(parts), parts.items()
        for name, other in others:
            warn(*compare_fingerprints(first, dict(one.fingerprint), name, dict(other.fingerprint)))
        with self.output.open(self) as folder:
            self._report(merged, folder)

    def _replay(self, file: Path, seed: int) -> None:
        """Replay one episode with the same policy, seed and conditions; `ManipError` if its outcome differs."""
        from manip_il.evaluation.film import film_episode, run_states
        from manip_il.evaluation.results import EvalResult
        from manip_il.evaluation.runner import episode_result, replay_differences

        if self.video is not None:
            OutputFile(self.video, overwrite=self.output.overwrite).check()
        result = EvalResult.read(file)
        by_seed = {episode.seed: episode for episode in result.episodes}
        if seed not in by_seed:
            raise UsageError(f"--replay is {seed}; {file} has seeds {min(by_seed)} to {max(by_seed)}")
        before, job = by_seed[seed], self._job_of(result, file)
        episode = run_states(job, seed)
        ended = "success" if before.success else f"failure in phase {before.phase_at_end}"
        say(f"seed {seed}, {before.detail.get('condition', 'nominal')}: {ended}")
        say(*(f"  {name}: {json.dumps(value)}" for name, value in before.detail.get("drawn", {}).items()))
        if self.video is not None:
            write_file(self.video, film_episode(job.env, episode).mp4)
            say(f"video: {self.video}")
        if differences := replay_differences(before, episode_result(job, episode)):
            raise ManipError(
                f"the episode of seed {seed} differs from {file}: {'; '.join(differences)}; compare success rates, "
                "not single episodes, across machines and versions"
            )
        say(f"the same as in {file}")

    def _job_of(self, result: EvalResult, file: Path) -> RolloutJob:
        """Return the rollout job of an evaluation; warn if the policy or this program has changed since.

        The policy, and a robot, a task or a mesh of the user's own, must be given again: no path in the file is opened.
        """
        from manip_il.cli.inputs import open_driver
        from manip_il.collect.environments import env_fingerprint, env_spec
        from manip_il.collect.job import RolloutJob
        from manip_il.data.fingerprint import compare_fingerprints, policy_sha256
        from manip_il.evaluation.policy_folder import find_policy
        from manip_il.evaluation.results import require_equal

        settings, own = result.settings, self.env
        env = result.env(own["robot"], own["task"], own["object"])
        require_equal(str(file), result, "what is given", env_spec(env), "robot", "task")
        if self.policy.path is None and result.policy not in NO_FILES:
            raise UsageError(f"{file} evaluates the policy {shorten(result.policy)}; give that with --policy.path=DIR")
        path = None if self.policy.path is None else find_policy(self.policy.path)
        _, driver, cameras = open_driver(path, result.policy, env, trust=self.trust)
        if path is not None and result.policy_sha256 not in ("", policy_sha256(path)):
            warn(f"{path} is not the policy of {file}: its files differ")
        here = env_fingerprint(env, cameras)
        warn(*compare_fingerprints(str(file), dict(result.fingerprint), "this machine", here))
        return RolloutJob(env, driver, settings.hold, label="last", conditions=settings.conditions)


def machine() -> str:
    """Return the OpenGL renderer and the number of cores. Raises if an environment cannot start or render here."""
    import tempfile

    from manip_il.collect.workers import default_workers
    from manip_il.sim import render
    from manip_il.sim.config import CAMERAS, CameraConfig
    from manip_il.tasks.envs import make_env

    tempfile.TemporaryFile().close()  # workers need a folder for temporary files
    env = make_env()
    env.start(0)
    render.pictures(env.scene, env.data, CameraConfig(CAMERAS))
    from OpenGL import GL  # imported after mujoco has set PYOPENGL_PLATFORM

    renderer = GL.glGetString(GL.GL_RENDERER) or b"unknown renderer"
    return f"{renderer.decode()}; cores {default_workers()}"
