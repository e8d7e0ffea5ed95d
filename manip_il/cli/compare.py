"""`manip-il compare`: two policies or runs on the same seeds, and the confidence in their difference."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.dagger import FREE
from manip_il.cli.inputs import check_policy
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, open_output, require_output
from manip_il.cli.progress import Stages, say, warn
from manip_il.errors import MismatchError, UsageError
from manip_il.evaluation.policy_folder import require_source
from manip_il.option import option
from manip_il.seeding import stream_seeds

if TYPE_CHECKING:
    from manip_il.evaluation.arm import Arm, Member
    from manip_il.evaluation.comparison import Comparison
    from manip_il.evaluation.trial import Trial
    from manip_il.sim.config import EnvConfig

AT_HELP = (
    "which rounds of a run count: end (all), labels, episodes, steps or seconds (up to what every run reached; seconds "
    "of collecting and fitting), or an amount, as in labels:5000"
)


@dataclass
class CompareOptions:
    """Compare two policies, runs, or folders of several training seeds, on the same test seeds.

    Each side is an eval.json, a policy, a run of manip-il dagger, or a folder with such things named seed_0, seed_1
    and so on. Two eval.json are compared as they are; all else is evaluated first. Writes compare.json and report.html.
    """

    example: ClassVar[str] = "manip-il compare runs/cloning runs/dagger --at=labels --output_dir=runs/compare"
    left: Path = option(MISSING, "one side", positional=True)
    right: Path = option(MISSING, "the other side", positional=True)
    checkpoint: Literal["best", "last"] = option("best", "of a run: best on validation, or the last round")
    at: str = option("end", AT_HELP)
    eval: common.TrialGroup = field(default_factory=common.TrialGroup)
    suite: str = option("nominal", common.SUITE_HELP)
    robot: common.MaybeRobotGroup = field(default_factory=common.MaybeRobotGroup)
    task: common.MaybeTaskGroup = field(default_factory=common.MaybeTaskGroup)
    env: common.EnvGroup = field(default_factory=common.EnvGroup)
    seed: int = option(0, "shifts the stream of test seeds, 0 to 1000")
    engine: Literal["local", "ray"] = common.engine_option()
    workers: int | None = common.workers_option()
    trust: bool = common.trust_option()
    output_dir: Path = option(Path("runs/compare"), "folder of compare.json")
    resume: bool = option(False, "continue an interrupted comparison")
    overwrite: bool = option(False, "replace an existing comparison")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        for side in (self.left, self.right):
            require_source(side)
        from manip_il.evaluation.rounds import Rule  # here, as what is above needs no statistics
        from manip_il.evaluation.suites import require_suite

        Rule.parse(self.checkpoint, self.at)
        if self.eval.n_episodes < 1:
            raise UsageError(f"--eval.n_episodes is {self.eval.n_episodes}; expected at least 1")
        if self.left.resolve() == self.right.resolve():
            raise UsageError(f"{self.left} is compared with itself; give two different ones")
        common.require_workers(self.workers)
        require_suite(self.suite)
        require_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)

    def run(self) -> None:
        """Evaluate what is not evaluated yet, compare, print and write the answer."""
        from manip_il.collect.workers import Engine
        from manip_il.evaluation.arm import read_arm, require_pair
        from manip_il.evaluation.compare_report import compare_report, comparison_table
        from manip_il.evaluation.comparison import FILE_NAME, Comparison, seeds_facts
        from manip_il.evaluation.results import write_json
        from manip_il.evaluation.rounds import Rule
        from manip_il.evaluation.tables import print_table

        rule = Rule.parse(self.checkpoint, self.at)
        both = [read_arm(self.left), read_arm(self.right)]
        require_pair(*both)
        members = [member for arm in both for member in arm.members]
        warn(
            *(f"{one.name} is not finished: its {len(one.history)} rounds count" for one in members if not one.finished)
        )
        limit = rule.limit({member.name: member.history for member in members})
        arms = [arm.map(lambda member: member.select(rule, limit)) for arm in both]
        trial = self._trial([member for arm in arms for member in arm.members])
        with open_output(self, FREE) as folder:
            kept = f"every finished evaluation, in {folder}"
            with Stages(kept) as stages, Engine(self.workers, self.engine) as engine:
                last = (trial, folder, engine, stages)
                arms = [arm.map(lambda one: one.measure(*last)) for arm in arms]
            comparison = Comparison(*arms)
            write_json(folder / FILE_NAME, comparison.file_json() | {"rule": rule.to_json(limit)})
            chosen = any(member.chosen for arm in arms for member in arm.members)
            facts = [*([rule.fact(limit)] if chosen else []), *seeds_facts(len(comparison.pairs))]
            report = compare_report(comparison, command_line("compare", self), facts, to_plain(self))
            report.write(folder / REPORT_FILE)
        print_table(comparison_table(comparison))
        for line in (*facts, comparison.verdict):
            say(line)
        say(f"result: {folder / FILE_NAME}")
        say(f"report: {folder / REPORT_FILE}")
        say(f"next: {self._next(comparison)}")

    def _trial(self, members: Sequence[Member]) -> Trial | None:
        """Return the test to run, checked; None if all is evaluated already."""
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.evaluation.arm import common_env
        from manip_il.evaluation.comparison import require_same_episodes
        from manip_il.evaluation.results import compare_results
        from manip_il.evaluation.trial import Trial

        if members[0].result is not None:
            first = members[0]
            for other in members[1:]:
                compare_results(first.test, other.test, (first.name, other.name))
                require_same_episodes(first.name, first.test, other.name, other.test)
                warn(*compare_fingerprints(first.name, first.test.fingerprint, other.name, other.test.fingerprint))
            return None
        policies = {member.name: member.policy for member in members if member.policy is not None}
        seeds = stream_seeds("test", self.eval.n_episodes, self.seed)
        trial = Trial.of(common_env(members, self._policy_env), seeds, self.suite, policies.values(), self.trust)
        check_policies(policies, trial, self.output_dir, self.engine)
        return trial

    def _policy_env(self, policy: Path) -> EnvConfig:
        from manip_il.learn.checkpoint import Checkpoint

        origin = Checkpoint.open(policy).origin
        return self.env.config(self.robot.type, self.task.type, origin, self.task.object, self.task.reward)

    def _next(self, comparison: Comparison) -> str:
        loser: Arm = comparison.left if comparison.difference > 0 else comparison.right
        if any(member.policy is None for arm in comparison.arms for member in arm.members):
            return "manip-il study --help  (does it hold for other training seeds?)"
        if self.suite == "nominal":
            output_dir = Path(f"{self.output_dir}_disturbed")
            return command_line("compare", replace(self, suite="disturbed", output_dir=output_dir))
        folder = f"--output_dir={self.output_dir}_films"
        return shlex.join(["manip-il", "eval", f"--policy.path={loser.members[0].policy}", "--eval.films=3", folder])


def check_policies(policies: dict[str, Path], trial: Trial, folder: Path, engine: str) -> None:
    """Raise, before any episode runs, if one of the policies (name -> folder) cannot take a test."""
    from manip_il.learn.checkpoint import Checkpoint

    for name, policy in policies.items():
        if not trial.file(folder, policy).is_file():
            checkpoint = Checkpoint.open(policy)
            origin = checkpoint.origin
            if origin is not None and origin.task != trial.env.task:
                raise MismatchError("task", name, origin.task, "the comparison", trial.env.task)
            check_policy(checkpoint, trial.env, draw=engine == "local", trust=trial.trust)
