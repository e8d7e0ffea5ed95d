"""`manip-il compare`: two policies or runs on the same seeds, and the confidence in their difference."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.candidates import Source, common_env, limit_of, match_seeds, read_candidate, require_candidate
from manip_il.cli.dagger import FREE
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, open_output, require_output
from manip_il.cli.progress import Stages, say, warn
from manip_il.cli.trials import SUITE_HELP, Trial, TrialGroup, require_suite
from manip_il.errors import UsageError
from manip_il.evaluation.comparison import FILE_NAME, Arm, Comparison, comparison_facts, require_same_episodes
from manip_il.evaluation.results import compare_results, write_json
from manip_il.evaluation.rounds import Rule
from manip_il.option import option
from manip_il.seeding import stream_seeds

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
    eval: TrialGroup = field(default_factory=TrialGroup)
    suite: str = option("nominal", SUITE_HELP)
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
        Rule.parse(self.checkpoint, self.at)
        if self.eval.n_episodes < 1:
            raise UsageError(f"--eval.n_episodes is {self.eval.n_episodes}; expected at least 1")
        for side in (self.left, self.right):
            require_candidate(side)
        if self.left.resolve() == self.right.resolve():
            raise UsageError(f"{self.left} is compared with itself; give two different ones")
        common.require_workers(self.workers)
        require_suite(self.suite)
        require_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)

    def run(self) -> None:
        """Evaluate what is not evaluated yet, compare, print and write the answer."""
        rule = Rule.parse(self.checkpoint, self.at)
        left, right, lines = match_seeds(read_candidate(self.left), read_candidate(self.right))
        both = (left, right)
        sources = [source for side in both for source in side.sources]
        warn(*lines)
        for source in sources:
            if not source.finished:
                warn(f"{source.name} is not finished: the {len(source.history)} rounds that it has count")
        limit = limit_of(rule, sources)
        trial = self._trial(sources, rule, limit)
        from manip_il.collect.workers import Engine
        from manip_il.evaluation.compare_report import compare_report, comparison_table
        from manip_il.evaluation.tables import print_table

        with open_output(self, FREE) as folder:
            kept = f"every finished evaluation, in {folder}"
            with Stages(kept) as stages, Engine(self.workers, self.engine) as engine:
                last = (rule, limit, trial, folder, engine, stages)
                arms = [Arm(str(side.path), tuple(one.measure(*last) for one in side.sources)) for side in both]
            comparison = Comparison(*arms)
            content = comparison.to_json() | {"rule": rule_json(rule, limit), **_test_json(comparison)}
            write_json(folder / FILE_NAME, content)
            facts = comparison_facts(comparison, rule, limit)
            report = compare_report(comparison, command_line("compare", self), facts, to_plain(self))
            report.write(folder / REPORT_FILE)
        print_table(comparison_table(comparison))
        for line in (*facts, comparison.verdict):
            say(line)
        say(f"result: {folder / FILE_NAME}")
        say(f"report: {folder / REPORT_FILE}")
        say(f"next: {self._next(comparison)}")

    def _trial(self, sources: Sequence[Source], rule: Rule, limit: float | None) -> Trial | None:
        """Return the test to run, checked; None where all is evaluated already."""
        results = [source for source in sources if source.result is not None]
        for other in results[1:]:
            _require_same(results[0], other)
        if len(results) == len(sources):
            return None
        env = common_env(sources, self.env, self.robot.type, self.task)
        policies = {source.name: source.select(rule, limit)[0] for source in sources if source.result is None}
        seeds = stream_seeds("test", self.eval.n_episodes, self.seed)
        trial = Trial.of(env, seeds, self.suite, policies.values(), self.trust)
        for source in results:
            trial.check_result(source.name, source.evaluation)
        trial.check_policies(policies, self.output_dir, self.engine)
        return trial

    def _next(self, comparison: Comparison) -> str:
        policies = [member.policy for arm in (comparison.left, comparison.right) for member in arm.members]
        if None in policies:
            return "manip-il study --help  (does it hold for other training seeds?)"
        if self.suite == "nominal":
            output_dir = Path(f"{self.output_dir}_disturbed")
            return command_line("compare", replace(self, suite="disturbed", output_dir=output_dir))
        loser = comparison.left if comparison.difference > 0 else comparison.right
        folder = f"--output_dir={self.output_dir}_films"
        return shlex.join(["manip-il", "eval", f"--policy.path={loser.members[0].policy}", "--eval.films=3", folder])


def rule_json(rule: Rule, limit: float | None) -> dict[str, Any]:
    """Return the rule as `compare.json` and `study.json` hold it."""
    return {"checkpoint": rule.checkpoint, "at": str(rule), "limit": limit}


def _test_json(comparison: Comparison) -> dict[str, Any]:
    result = comparison.left.members[0].result
    seeds = sorted(episode.seed for episode in result.episodes)
    return {
        "robot": result.robot,
        "task": result.task,
        "settings": result.settings.to_json(),
        "test_seeds": [seeds[0], seeds[-1]],
    }


def _require_same(left: Source, right: Source) -> None:
    from manip_il.data.fingerprint import compare_fingerprints

    ours, theirs = left.evaluation, right.evaluation
    compare_results(ours, theirs, (left.name, right.name))
    require_same_episodes(left.name, ours, right.name, theirs)
    warn(*compare_fingerprints(left.name, ours.fingerprint, right.name, theirs.fingerprint))
