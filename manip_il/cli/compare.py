"""`manip-il compare`: compare two policies or runs on the same seeds, and how sure that is."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from manip_il.cli.folders import prepare_output
from manip_il.cli.groups import (
    ENGINE_HELP,
    WORKERS_HELP,
    EnvGroup,
    MaybeRobotGroup,
    MaybeTaskGroup,
    check_same_options,
    command_line,
    option,
    save_options,
    trust_option,
    warn,
)
from manip_il.cli.measure import TEST_EPISODES, Trial, check_policies, measured, rule_json
from manip_il.cli.options import options_of, to_plain
from manip_il.cli.paths import require_output, require_workers
from manip_il.cli.progress import say
from manip_il.cli.sides import Side, Source, common_env, limit_of, matched, read_side, require_side
from manip_il.cli.suites import SUITE_HELP, require_suite
from manip_il.errors import UsageError
from manip_il.evaluation.comparison import FILE_NAME, Arm, Comparison, Member, require_same_episodes
from manip_il.evaluation.results import EvalResult, write_json
from manip_il.evaluation.rounds import Rule

if TYPE_CHECKING:
    from manip_il.cli.stages import Stages
    from manip_il.engine.engine import Engine

REPORT_FILE = "report.html"
FREE = ("workers", "engine", "output_dir", "trust")
AT_HELP = (
    "which rounds of a run count: end (all), labels, episodes or seconds (up to what every run reached; seconds of "
    "collecting and fitting), or an amount, as in labels:5000"
)


@dataclass
class TrialGroup:
    """`--eval.*`: what both sides are tested on."""

    n_episodes: int = option(TEST_EPISODES, "test episodes, the same for both sides")


@dataclass
class CompareOptions:
    """Compare two policies, runs, or folders of several training seeds, on the same test seeds.

    Each side is an eval.json, a policy, a run of manip-il dagger, or a folder with such things named seed_0, seed_1
    and so on. Two eval.json are compared as they are; all else is evaluated first. Writes compare.json and report.html.
    """

    example: ClassVar[str] = "manip-il compare runs/cloning runs/dagger --at=labels --output_dir=runs/compare"
    left: Path = field(metadata={"help": "one side", "positional": True})
    right: Path = field(metadata={"help": "the other side", "positional": True})
    checkpoint: Literal["best", "last"] = option("best", "of a run: best on validation, or the last round")
    at: str = option("end", AT_HELP)
    eval: TrialGroup = field(default_factory=TrialGroup)
    suite: str = option("nominal", SUITE_HELP)
    robot: MaybeRobotGroup = field(default_factory=MaybeRobotGroup)
    task: MaybeTaskGroup = field(default_factory=MaybeTaskGroup)
    env: EnvGroup = field(default_factory=EnvGroup)
    seed: int = option(0, "shifts the stream of test seeds, 0 to 1000")
    engine: Literal["local", "ray"] = option("local", ENGINE_HELP)
    workers: int | None = option(None, WORKERS_HELP)
    trust: bool = trust_option()
    output_dir: Path = field(default=Path("runs/compare"), metadata={"help": "folder of compare.json"})
    resume: bool = option(False, "continue an interrupted comparison")
    overwrite: bool = option(False, "replace an existing comparison")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        Rule.parse(self.checkpoint, self.at)
        if self.eval.n_episodes < 1:
            raise UsageError(f"--eval.n_episodes is {self.eval.n_episodes}; expected at least 1")
        for side in (self.left, self.right):
            require_side(side)
        if self.left.resolve() == self.right.resolve():
            raise UsageError(f"{self.left} is compared with itself; give two different ones")
        require_workers(self.workers)
        require_suite(self.suite)
        require_output(self.output_dir, "compare", resume=self.resume, overwrite=self.overwrite)

    def run(self) -> None:
        """Evaluate what is not evaluated yet, compare, print and write the answer."""
        rule = Rule.parse(self.checkpoint, self.at)
        left, right, lines = matched(read_side(self.left), read_side(self.right))
        warn([*lines, *_unfinished((*left.sources, *right.sources))])
        from manip_il.data.atomic import exclusive

        with exclusive(self.output_dir):
            self._run(rule, left, right)

    def _run(self, rule: Rule, left: Side, right: Side) -> None:
        limit = limit_of(rule, (*left.sources, *right.sources))
        trial = self._trial((*left.sources, *right.sources), rule, limit)
        prepare_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)
        if self.resume:
            check_same_options(self.output_dir, self, FREE)
        save_options(self.output_dir, self)
        left_arm, right_arm = self._measure((left, right), rule, limit, trial)
        comparison = Comparison(left_arm, right_arm)
        content = comparison.to_json() | {"rule": rule_json(rule, limit), **_test_json(comparison)}
        write_json(self.output_dir / FILE_NAME, content)
        self._report(comparison, rule, limit)
        self._say(comparison, rule, limit)

    def _trial(self, sources: Sequence[Source], rule: Rule, limit: float | None) -> Trial | None:
        """What is to be run; None where all is evaluated already. All that can be refused is refused here."""
        from manip_il.seeding import stream_seeds

        results = [source for source in sources if source.result is not None]
        for other in results[1:]:
            _require_same(results[0], other)
        if len(results) == len(sources):
            return None
        env = common_env(sources, self.env, self.robot.type, self.task.type)
        policies = {source.name: source.chosen(rule, limit)[0] for source in sources if source.result is None}
        seeds = stream_seeds("test", self.eval.n_episodes, self.seed)
        trial = Trial.of(env, seeds, self.suite, policies.values(), self.trust)
        for source in results:
            trial.check_result(source.name, _result(source))
        check_policies(trial, policies, self.output_dir, self.engine)
        return trial

    def _measure(self, sides: Sequence[Side], rule: Rule, limit: float | None, trial: Trial | None) -> list[Arm]:
        from manip_il.cli.stages import Stages
        from manip_il.engine.engine import Engine

        kept = f"every finished evaluation, in {self.output_dir}"
        with Stages(kept) as stages, Engine(self.workers, self.engine) as engine:
            return [
                Arm(
                    str(side.path),
                    tuple(self._measured(one, rule, limit, trial, engine, stages) for one in side.sources),
                )
                for side in sides
            ]

    def _measured(
        self, source: Source, rule: Rule, limit: float | None, trial: Trial | None, engine: Engine, stages: Stages
    ) -> Member:
        if source.result is not None or trial is None:
            return Member(source.name, _result(source), source.path, source.training_seed)
        return measured(source, rule, limit, trial, self.output_dir, engine, stages)

    def _report(self, comparison: Comparison, rule: Rule, limit: float | None) -> None:
        from manip_il.evaluation.compare_report import compare_report
        from manip_il.evaluation.comparison import comparison_facts

        facts = comparison_facts(comparison, rule, limit)
        report = compare_report(comparison, command_line("compare", self), facts, to_plain(self))
        report.write(self.output_dir / REPORT_FILE)

    def _say(self, comparison: Comparison, rule: Rule, limit: float | None) -> None:
        from manip_il.evaluation.compare_report import comparison_table
        from manip_il.evaluation.comparison import comparison_facts
        from manip_il.evaluation.tables import print_table

        print_table(comparison_table(comparison))
        for line in comparison_facts(comparison, rule, limit):
            say(line)
        say(comparison.verdict)
        say(f"result: {self.output_dir / FILE_NAME}")
        say(f"report: {self.output_dir / REPORT_FILE}")
        say(f"next: {self._next(comparison)}")

    def _next(self, comparison: Comparison) -> str:
        policies = [member.policy for arm in (comparison.left, comparison.right) for member in arm.members]
        if None in policies:
            return "manip-il study --help  (does it hold for other training seeds?)"
        if self.suite == "nominal":
            return self._disturbed()
        loser = comparison.left if comparison.difference > 0 else comparison.right
        folder = f"--output_dir={self.output_dir}_films"
        return shlex.join(["manip-il", "eval", f"--policy.path={loser.members[0].policy}", "--eval.films=3", folder])

    def _disturbed(self) -> str:
        """This comparison once more, in a rougher world."""
        places = {"left", "right", "suite", "output_dir", "resume", "overwrite"}
        words = ["manip-il", "compare", str(self.left), str(self.right), "--suite=disturbed"]
        words += [f"--output_dir={self.output_dir}_disturbed"]
        for known in options_of(type(self)):
            value = functools.reduce(getattr, known.name.split("."), self)
            if known.name not in places and value != known.default:
                words.append(f"--{known.name}={str(value).lower() if isinstance(value, bool) else value}")
        return shlex.join(words)


def _test_json(comparison: Comparison) -> dict[str, Any]:
    result = comparison.left.members[0].result
    seeds = sorted(episode.seed for episode in result.episodes)
    return {
        "robot": result.robot,
        "task": result.task,
        "settings": result.settings.to_json(),
        "test_seeds": [seeds[0], seeds[-1]],
    }


def _unfinished(sources: Sequence[Source]) -> list[str]:
    return [
        f"{source.name} is not finished: the {len(source.history)} rounds that it has count"
        for source in sources
        if not source.finished
    ]


def _require_same(left: Source, right: Source) -> None:
    from manip_il.data.fingerprint import compare_fingerprints
    from manip_il.evaluation.results import compare_results

    ours, theirs = _result(left), _result(right)
    compare_results(ours, theirs, (left.name, right.name))
    require_same_episodes(left.name, ours, right.name, theirs)
    warn(compare_fingerprints(left.name, ours.fingerprint, right.name, theirs.fingerprint))


def _result(source: Source) -> EvalResult:
    assert source.result is not None
    return source.result
