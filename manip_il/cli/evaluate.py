"""`manip-il eval`: how often a policy succeeds on seeds that nothing was chosen on."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.options import Given, command_line, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say
from manip_il.errors import UsageError
from manip_il.option import option
from manip_il.tasks.stock.table import ROBOTS

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.evaluation.report import Film
    from manip_il.evaluation.results import EvalResult

EPISODES, MOST_EPISODES = 100, 10_000


@dataclass
class MeasuredPolicyGroup:
    """`--policy.*` of what is measured."""

    path: Path | None = common.policy_option()
    type: Literal["expert", "random"] | None = option(None, "instead of a checkpoint")
    device: str = option("cpu", "where the checkpoint acts: cpu or cuda")


@dataclass
class EvalGroup:
    """`--eval.*`: the episodes to run."""

    n_episodes: int | None = option(
        None,
        f"episodes, each with its own seed; by default {EPISODES}, with until_width at most {MOST_EPISODES:,}",
        at_least=1,
        grows=True,
    )
    first: int = option(0, "index of the first seed in the stream, for one part of a larger evaluation", at_least=0)
    hold: int | None = option(
        10, "control steps after success at which an episode ends; null: at the horizon", at_least=0
    )
    batch_size: int = option(
        25, "episodes in lockstep that share a call of the policy; no result depends on it", at_least=1, free=True
    )
    stream: Literal["test", "validation"] = option("test", "which seeds; those of test were used for no choice")
    films: int = option(2, "number of failures to film, and of successes", at_least=0, free=True)


@dataclass
class EvalOptions:
    """Measure a policy's success on unseen seeds; writes eval.json and report.html.

    With EVALUATION, an eval.json or its folder, nothing new is measured: --replay=SEED runs one of its episodes again,
    alone, and films it; two or more are merged, as parts that several machines ran. --check draws a picture, and says
    whether this machine or container can evaluate.
    """

    example: ClassVar[str] = "manip-il eval --policy.type=expert --eval.n_episodes=200 --output_dir=runs/expert"
    first: ClassVar[str] = "policy.path policy.type eval.n_episodes suite robot.type task.type output_dir replay resume"
    evaluation: list[Path] = option(
        list, "evaluations: one, with --replay, or several to merge", positional=True, check=common.require_eval
    )
    policy: MeasuredPolicyGroup = field(default_factory=MeasuredPolicyGroup)
    env: Given = common.env_given(of_policy=True)
    eval: EvalGroup = field(default_factory=EvalGroup)
    suite: str = common.suite_option()
    until_width: float | None = option(None, "stop when the interval is this narrow; 0.02 is 2 points")
    seed: int = common.seed_option()
    engine: common.EngineOptions = group(common.EngineOptions(), prefix="")
    trust: bool = common.trust_option()
    output: ResumableOutput = group(ResumableOutput(Path("runs/eval")), prefix="")
    replay: int | None = option(None, "seed of the episode of EVALUATION to run again", at_least=0, free=True)
    video: Path | None = option(None, "an MP4 of it to write", free=True)
    health: bool = option(False, "check that this machine can evaluate and render", flag="check", free=True)

    def check(self) -> None:
        """Refuse what does not go together."""
        if self.replay is not None and len(self.evaluation) != 1:
            raise UsageError("--replay is for an episode of one evaluation; give its EVALUATION first")
        if self.health or self.replay is not None:
            return
        if len(self.evaluation) == 1:
            raise UsageError("expected two or more evaluations to merge, or one and --replay=SEED")
        if not self.evaluation and (self.policy.path is None) == (self.policy.type is None):
            raise UsageError("give one of --policy.path=DIR and --policy.type=expert|random")
        if self.until_width is not None and not 0 < self.until_width < 1:
            raise UsageError(f"--until_width is {self.until_width}; expected between 0 and 1: 0.02 for 2 points")
        self.output.check()

    def run(self) -> None:
        """Run the episodes, write `eval.json` and `report.html`, print the table."""
        from manip_il.cli import eval_files

        if self.health:
            say(f"healthy: {eval_files.machine()}")
        elif self.replay is not None:
            own = {name: self.env[name] for name in ("task", "object") if self.env.get(name) is not None}
            eval_files.replay(self.evaluation[0], self.replay, self.policy.path, self.video, own, trust=self.trust)
        elif self.evaluation:
            merged = eval_files.merge(self.evaluation)
            with self.output.open(self) as folder:
                self._report(merged, folder)
        else:
            self._evaluate()

    def _evaluate(self) -> None:
        from manip_il.evaluation.film import film_outcomes
        from manip_il.evaluation.runner import finished_episodes, measure
        from manip_il.seeding import stream_seeds

        most = EPISODES if self.until_width is None else MOST_EPISODES
        end = self.eval.first + (self.eval.n_episodes or most)
        seeds = stream_seeds(self.eval.stream, end, self.seed)[self.eval.first :]
        name, engine = str(self.policy.type or self.policy.path), self.engine.open()
        if len(seeds) > 1:
            engine.warm_up(learned=self.policy.path is not None)  # while the policy is checked here
        job, suite, width = self._job(), self.suite, self.until_width
        with self.output.open(self) as folder:
            finished_episodes(folder, job, suite)  # refuses another policy before anything runs
            with Stages(f"finished episodes, in {folder}") as stages, engine:
                result = measure(engine, job, seeds, name, folder, stages, suite=suite, until_width=width)
                films = film_outcomes(engine, job, result, self.eval.films, folder / "films", stages)
            self._report(result, folder, *films)
        seed = next((one.seed for one in result.episodes if not one.success), result.episodes[0].seed)
        # a robot's file is in eval.json; a task's is given each time
        own = common.own_names("panda", job.env.task, job.env.object)
        say(f"next: manip-il eval {shlex.quote(str(folder))} --replay={seed}{own} --video=replay.mp4")

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
        """Write the result and its page, and print its tables."""
        from manip_il.evaluation.eval_report import eval_report
        from manip_il.evaluation.results import FILE_NAME
        from manip_il.evaluation.tables import evaluation_table, print_table

        result.write(folder / FILE_NAME)
        page = eval_report(result, command_line("eval", self), to_plain(self), films, no_films)
        page.write(folder / REPORT_FILE)
        print_table(evaluation_table(result))
        if result.failures:
            phases = ", ".join(f"{phase} {count}" for phase, count in result.failures.items())
            say(f"failures by the phase that they ended in: {phases}")
        if result.robot in ROBOTS:
            say(f"return: {mean(episode.ret for episode in result.episodes):.2f}")
        say(f"result: {folder / FILE_NAME}", f"report: {folder / REPORT_FILE}")
