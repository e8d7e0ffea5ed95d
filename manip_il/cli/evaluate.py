"""`manip-il eval`: how often a policy succeeds on seeds that nothing was chosen on."""

from __future__ import annotations

import contextlib
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean, pstdev
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.eval_files import say_result
from manip_il.cli.inputs import check_policy, find_policy, observation_text
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, open_output, require_output
from manip_il.cli.progress import Stages, say
from manip_il.errors import ManipError, UsageError
from manip_il.option import option
from manip_il.stock.table import ROBOT

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.collect.workers import Engine
    from manip_il.evaluation.results import EvalResult

EPISODES, MOST_EPISODES = 100, 10_000
FILMS = "films"
FREE = ("workers", "engine", "output_dir", "eval.films", "eval.batch_size", "trust", "action_space")


@dataclass
class MeasuredPolicyGroup:
    """`--policy.*` of what is measured."""

    path: Path | None = option(None, "a checkpoint or a run")
    type: Literal["expert", "random"] | None = option(None, "instead of a checkpoint")


@dataclass
class EvalGroup:
    """`--eval.*`: the episodes to run."""

    n_episodes: int | None = option(
        None, f"episodes, each with its own seed; by default {EPISODES}, with until_width at most {MOST_EPISODES:,}"
    )
    first: int = option(0, "index of the first seed in the stream, for one part of a larger evaluation")
    hold: int | None = option(10, "control steps after success at which an episode ends; null: at the horizon")
    batch_size: int = option(25, "episodes in lockstep that share a call of the policy; no result depends on it")
    stream: Literal["test", "validation"] = option("test", "which seeds; those of test were used for no choice")
    films: int = option(2, "number of failures to film, and of successes")


@dataclass
class EvalOptions:
    """Measure a policy's success on unseen seeds; writes eval.json and report.html."""

    example: ClassVar[str] = "manip-il eval --policy.type=expert --eval.n_episodes=200 --output_dir=runs/expert"
    policy: MeasuredPolicyGroup = field(default_factory=MeasuredPolicyGroup)
    action_space: Literal["joint_target", "joint_delta", "ee_delta"] | None = option(
        None, "refuse a policy that learnt in another; by default what its checkpoint says"
    )
    robot: common.MaybeRobotGroup = field(default_factory=common.MaybeRobotGroup)
    task: common.MaybeTaskGroup = field(default_factory=common.MaybeTaskGroup)
    env: common.EnvGroup = field(default_factory=common.EnvGroup)
    eval: EvalGroup = field(default_factory=EvalGroup)
    suite: str = option("nominal", common.SUITE_HELP)
    until_width: float | None = option(None, "stop when the interval is this narrow; 0.02 is 2 points")
    seed: int = common.seed_option()
    engine: Literal["local", "ray"] = common.engine_option()
    workers: int | None = common.workers_option()
    trust: bool = common.trust_option()
    output_dir: Path = option(Path("runs/eval"), "folder of eval.json")
    resume: bool = option(False, "continue an interrupted evaluation, or add more episodes")
    overwrite: bool = option(False, "replace an existing evaluation")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        if (self.policy.path is None) == (self.policy.type is None):
            raise UsageError("give one of --policy.path=DIR and --policy.type=expert|random")
        if self.policy.type is not None and self.action_space not in (None, "joint_target"):
            raise UsageError(f"--action_space={self.action_space} is for a checkpoint, not for {self.policy.type}")
        for name, lowest in (("n_episodes", 1), ("films", 0), ("first", 0), ("hold", 0), ("batch_size", 1)):
            value = getattr(self.eval, name)
            if value is not None and value < lowest:
                raise UsageError(f"--eval.{name} is {value}; expected at least {lowest}")
        if self.until_width is not None and not 0 < self.until_width < 1:
            raise UsageError(f"--until_width is {self.until_width}; expected between 0 and 1: 0.02 for 2 points")
        self._seeds()
        common.require_workers(self.workers)
        if self.policy.path is not None:
            self._check_space(find_policy(self.policy.path))
        from manip_il.evaluation.suites import require_suite

        require_suite(self.suite)
        require_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)
        self.env.config(self.robot.type, self.task.type, shape=self.task.object, reward=self.task.reward)

    def run(self) -> None:
        """Run the episodes, write `eval.json` and `report.html`, print the table."""
        from manip_il.cli.dagger import run_curve
        from manip_il.collect.workers import Engine
        from manip_il.evaluation.eval_report import eval_report
        from manip_il.evaluation.film import film_outcomes
        from manip_il.evaluation.results import FILE_NAME
        from manip_il.evaluation.runner import EpisodeJournal, evaluate

        seeds, name, folder = self._seeds(), str(self.policy.type or self.policy.path), self.output_dir
        engine = Engine(self.workers, self.engine)
        job = self._job(engine, len(seeds))
        with contextlib.ExitStack() as held:
            try:  # before the first episode
                held.enter_context(open_output(self, FREE, may_grow="eval.n_episodes"))
            except OSError as error:
                raise ManipError(
                    f"{folder} cannot be written to ({error.strerror}); choose another --output_dir, or in a "
                    'container run as the owner of the folder: docker run --user "$(id -u):$(id -g)"'
                ) from error
            journal = EpisodeJournal.open(folder, job, self.suite)
            with Stages(f"finished episodes, in {folder}") as stages, engine:
                stages.start(f"evaluate {name}", len(set(seeds) - set(journal.done)))
                keep = journal.keep(stages.episode)
                done, width = journal.done, self.until_width
                result = evaluate(engine, job, seeds, name, keep, suite=self.suite, done=done, until_width=width)
                stages.close()
                result.write(folder / FILE_NAME)
                self._say(result)
                films = film_outcomes(engine, job, result, self.eval.films, folder / FILMS, stages)
            curve = run_curve(self.policy.path)
            eval_report(result, command_line("eval", self), to_plain(self), *films, curve).write(folder / REPORT_FILE)
        say(f"result: {folder / FILE_NAME}")
        say(f"report: {folder / REPORT_FILE}")
        say(f"next: {self._next(result)}")

    def _seeds(self) -> range:
        from manip_il.seeding import stream_seeds

        most = EPISODES if self.until_width is None else MOST_EPISODES
        count = self.eval.n_episodes or most
        return stream_seeds(self.eval.stream, self.eval.first + count, self.seed)[self.eval.first :]

    def _job(self, engine: Engine, episodes: int) -> RolloutJob:
        from manip_il.collect.drivers import PolicyDriver, driver_of
        from manip_il.collect.job import RolloutJob
        from manip_il.evaluation.suites import suite_conditions
        from manip_il.evaluation.trial import episode_hold

        path = None if self.policy.path is None else find_policy(self.policy.path)
        if episodes > 1:
            engine.warm_up(learned=path is not None)  # while the policy is checked here
        checkpoint = meta = cameras = None
        if path is not None:
            from manip_il.learn.checkpoint import Checkpoint

            checkpoint = Checkpoint.open(path)
            meta = checkpoint.origin
        env = self.env.config(self.robot.type, self.task.type, meta, self.task.object, self.task.reward)
        if path is not None and checkpoint is not None:
            cameras = check_policy(checkpoint, env, draw=self.engine == "local", trust=self.trust)
            if cameras is not None:
                say(observation_text(cameras, path))
        conditions = suite_conditions(self.suite, env, sees=cameras is not None)
        driver = PolicyDriver((path,), trust=self.trust) if path is not None else driver_of(self.policy.type)
        job = RolloutJob(env, driver, episode_hold(env, self.eval.hold), label="last", conditions=conditions)
        return replace(job, batch=self.eval.batch_size)

    def _check_space(self, path: Path) -> None:
        """Raise `MismatchError` for a checkpoint of another action space than the one asked for."""
        if self.action_space is None:
            return
        from manip_il.errors import MismatchError
        from manip_il.learn.checkpoint import Checkpoint

        if (space := Checkpoint.open(path).space) != self.action_space:
            raise MismatchError("action space", str(path), space, "--action_space", self.action_space)

    def _say(self, result: EvalResult) -> None:
        say_result(result)
        if result.robot == ROBOT:
            returns = [episode.ret for episode in result.episodes]
            say(f"return: {mean(returns):.2f}, standard deviation {pstdev(returns):.2f}")
        if self.until_width is not None:
            low, high = result.success.interval
            reached = high - low <= self.until_width
            say(
                f"stopped after {len(result.episodes):,} episodes: the interval is {100 * (high - low):.2f} points wide"
                + ("" if reached else f", not {100 * self.until_width:g} yet; give more --eval.n_episodes")
            )

    def _next(self, result: EvalResult) -> str:
        failed = [index for index, episode in enumerate(result.episodes) if not episode.success]
        if self.suite == "nominal" and not failed:
            words: dict[str, Any] = {"suite": "all", "output_dir": Path(f"{self.output_dir}_all")}
            return command_line("eval", replace(self, **words))
        path = self.output_dir / "eval.json"
        return shlex.join(["manip-il", "replay", str(path), "--episode", str((failed or [0])[0]), "--video=replay.mp4"])
