"""`manip-il eval`: success on unseen seeds, with its interval."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli.folders import atomic_write, prepare_output
from manip_il.cli.groups import (
    DEFAULT_HZ,
    DEFAULT_ROBOT,
    DEFAULT_TASK,
    ENGINE_HELP,
    WORKERS_HELP,
    EnvGroup,
    find_policy,
    option,
    save_options,
    warn,
)
from manip_il.cli.progress import say
from manip_il.errors import FolderExistsError, RenderError, UsageError

if TYPE_CHECKING:
    from manip_il.engine.jobs import RolloutJob
    from manip_il.evaluation.results import EvalResult
    from manip_il.learn.checkpoint import CheckpointMeta
    from manip_il.mdp import Episode, Observation
    from manip_il.sim.env import EnvConfig
    from manip_il.sim.look import CameraConfig

FILMS = "films"


@dataclass
class WhoGroup:
    """`--policy.*` of what is measured."""

    path: Path | None = field(default=None, metadata={"help": "a checkpoint or a run"})
    type: Literal["expert", "random"] | None = option(None, "in place of a checkpoint")


@dataclass
class MaybeRobotGroup:
    """`--robot.*` where a checkpoint may say it."""

    type: str | None = option(None, f"panda or fetch; by default the policy's, else {DEFAULT_ROBOT}")


@dataclass
class MaybeTaskGroup:
    """`--task.*` where a checkpoint may say it."""

    type: str | None = option(None, f"reach, lift or pick_place; by default the policy's, else {DEFAULT_TASK}")


@dataclass
class EvalGroup:
    """`--eval.*`: what is run."""

    n_episodes: int = option(100, "episodes, each on a seed of its own")
    disturbance: Literal["none", "standard"] = option("none", "standard: the object is knocked, actions are noisy")
    stream: Literal["test", "validation"] = option("test", "seeds: test is what nothing was chosen on")
    films: int = option(0, "film this many episodes, the first ones")


@dataclass
class EvalOptions:
    """Measure a policy's success on unseen seeds; writes eval.json."""

    example: ClassVar[str] = "manip-il eval --policy.type=expert --eval.n_episodes=200 --output_dir=runs/expert"
    policy: WhoGroup = field(default_factory=WhoGroup)
    robot: MaybeRobotGroup = field(default_factory=MaybeRobotGroup)
    task: MaybeTaskGroup = field(default_factory=MaybeTaskGroup)
    env: EnvGroup = field(default_factory=EnvGroup)
    eval: EvalGroup = field(default_factory=EvalGroup)
    seed: int = option(0, "shifts every random stream, 0 to 1000")
    engine: Literal["local", "ray"] = option("local", ENGINE_HELP)
    workers: int | None = option(None, WORKERS_HELP)
    output_dir: Path = field(default=Path("runs/eval"), metadata={"help": "folder of eval.json"})
    overwrite: bool = option(False, "replace an evaluation that is there")

    def run(self) -> None:
        """Run the episodes, write `eval.json`, print the table."""
        if (self.policy.path is None) == (self.policy.type is None):
            raise UsageError("give one of --policy.path=DIR and --policy.type=expert|random")
        if self.eval.n_episodes < 1 or self.eval.films < 0:
            raise UsageError(
                f"--eval.n_episodes is {self.eval.n_episodes}, --eval.films {self.eval.films}; "
                "expected at least 1 and at least 0"
            )
        job = self._job()
        from manip_il.evaluation.results import FILE_NAME

        try:
            prepare_output(self.output_dir, resume=False, overwrite=self.overwrite)
        except FolderExistsError:
            raise UsageError(f"{self.output_dir} exists already; replace it by --overwrite=true") from None
        save_options(self.output_dir, self)
        result, filmed = self._evaluate(job)
        result.write(self.output_dir / FILE_NAME)
        self._say(result)
        if filmed:
            _write_films(filmed, job.env, self.output_dir / FILMS)
        say(f"result: {self.output_dir / FILE_NAME}")
        say(f"next: {self._next()}")

    def _job(self) -> RolloutJob:
        if self.policy.path is None:
            env = self._env(None)
            from manip_il.engine.jobs import RolloutJob

            driver, path = self.policy.type, None
        else:
            from manip_il.engine.jobs import RolloutJob
            from manip_il.learn.checkpoint import read_meta

            driver, path = "policy", find_policy(self.policy.path)
            meta = read_meta(path)
            env = self._env(meta)
            cameras = check_policy(path, meta, env, draw=self.engine == "local")
            if cameras is not None:
                say(_looks(cameras, path))
        from manip_il.sim.disturb import NONE, STANDARD

        disturbance = STANDARD if self.eval.disturbance == "standard" else NONE
        return RolloutJob(env, driver or "random", policy=path, labels="last", disturbance=disturbance)

    def _env(self, meta: CheckpointMeta | None) -> EnvConfig:
        robot = self.robot.type or (meta.robot if meta else DEFAULT_ROBOT)
        task = self.task.type or (meta.task if meta else DEFAULT_TASK)
        return self.env.config(robot, task, meta.fps if meta else DEFAULT_HZ)

    def _evaluate(self, job: RolloutJob) -> tuple[EvalResult, list[Episode]]:
        from manip_il.cli.progress import progress
        from manip_il.engine.engine import Engine
        from manip_il.evaluation.runner import evaluate
        from manip_il.seeding import stream_seeds

        seeds = stream_seeds(self.eval.stream, self.eval.n_episodes, self.seed)
        filmed: dict[int, Episode] = {}
        solved = 0
        with (
            progress(len(seeds), f"evaluate {self._name()}") as bar,
            Engine(self.workers, self.engine) as engine,
        ):

            def seen(episode: Episode) -> None:
                nonlocal solved
                solved += episode.success
                bar.advance(solved=solved)
                if episode.seed < seeds[0] + self.eval.films:
                    filmed[episode.seed] = episode

            result = evaluate(engine, job, seeds, self._name(), seen)
        return result, [filmed[seed] for seed in sorted(filmed)]

    def _name(self) -> str:
        return str(self.policy.type or self.policy.path)

    def _say(self, result: EvalResult) -> None:
        from manip_il.evaluation.report_data import PolicyRow
        from manip_il.evaluation.terminal import print_results

        kind = {"expert": "expert", "random": "baseline"}.get(self.policy.type or "", "dagger")
        print_results([PolicyRow.of(self._name(), result, kind=kind)])  # pyright: ignore[reportArgumentType]
        if result.failures:
            failures = ", ".join(f"{phase} {count}" for phase, count in result.failures.items())
            say(f"failures by the phase that they ended in: {failures}")

    def _next(self) -> str:
        who = f"--policy.path={self.policy.path}" if self.policy.path else f"--policy.type={self.policy.type}"
        if self.eval.disturbance == "none":
            return f"manip-il eval {who} --eval.disturbance=standard --output_dir={self.output_dir}_disturbed"
        return f"manip-il eval {who} --eval.films=3 --output_dir={self.output_dir}_filmed"


def check_policy(path: Path, meta: CheckpointMeta | None, env: EnvConfig, *, draw: bool = True) -> CameraConfig | None:
    """The cameras that the policy looks at, None for none; warns where it was trained on something else than `env`.

    draw: make its first pictures here, to see that they can be made. Raises `MismatchError` unless the policy can drive
    `env`, `RenderError` where there is no OpenGL for its pictures, and what `LearnedPolicy.load` raises.
    """
    from manip_il.engine.describe import env_spec
    from manip_il.engine.sight import policy_cameras
    from manip_il.learn.checkpoint import check_fits
    from manip_il.learn.policy import LearnedPolicy
    from manip_il.learn.pretrained import check_interface, read_interface

    cameras = policy_cameras(path)
    spec = env_spec(env, cameras)
    if meta is not None:
        check_fits(meta, spec)
    check_interface(read_interface(path), spec)
    warn(_differences(path, meta, env, cameras))
    policy = LearnedPolicy.load(path, task=spec.instruction)
    # One action now says what else would not fit before a worker does.
    seen = _first_sight(env, cameras, draw)
    images = {camera: picture[None] for camera, picture in seen.images.items()}
    policy.act(seen.state[None], seen.environment_state[None], images)
    return cameras


def _differences(path: Path, meta: CheckpointMeta | None, env: EnvConfig, cameras: CameraConfig | None) -> list[str]:
    from manip_il.data.fingerprint import compare_fingerprints
    from manip_il.engine.describe import env_fingerprint

    if meta is None:
        lines = [f"{path} was written by another tool and does not say which robot and task it is for"]
        return [*lines, f"nor in what light its pictures were made: {cameras.look} is assumed"] if cameras else lines
    lines = [f"task differs: {path} has {meta.task}, the environment has {env.task}"] if meta.task != env.task else []
    theirs = dict(meta.fingerprint)
    if cameras is None:
        theirs.pop("cameras_sha256", None)  # it sees none
    return lines + compare_fingerprints(str(path), theirs, "the environment", env_fingerprint(env, cameras))


def _first_sight(env: EnvConfig, cameras: CameraConfig | None, draw: bool) -> Observation:
    import numpy as np

    from manip_il.sim.env import ManipEnv

    if cameras is None or not draw:
        world = ManipEnv(config=env)
    else:
        world = ManipEnv(config=env, cameras=cameras.names, image_size=cameras.size, look=cameras.look)
    world.start(0)
    seen = world.observe()
    if cameras is not None and not draw:
        return replace(seen, images={name: np.zeros((*cameras.size, 3), np.uint8) for name in cameras.names})
    return seen


def _looks(cameras: CameraConfig, path: Path) -> str:
    from manip_il.learn.observation import observation_of
    from manip_il.learn.pretrained import read_interface

    observation = observation_of(read_interface(path).columns)
    lights = ", ".join(f"{name} {value}" for name, value in asdict(cameras.look).items())
    size = f"{cameras.height} x {cameras.width} pixels"
    return f"observation {observation!r}: the policy looks at {', '.join(cameras.names)}, {size}, {lights}"


def _write_films(episodes: list[Episode], env: EnvConfig, folder: Path) -> None:
    from manip_il.evaluation.film import encode_mp4, film

    try:
        for episode in episodes:
            outcome = "success" if episode.success else "failure"
            frames = film(episode, env)
            atomic_write(folder / f"seed_{episode.seed}_{outcome}.mp4", encode_mp4(frames, env.control_hz))
    except RenderError as error:
        warn([f"no films: {error}"])
        return
    say(f"films: {folder}")
