"""`manip-il compare`: two policies or runs on the same seeds and the confidence in their difference, or a study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli import common_options as common
from manip_il.cli.inputs import check_policies
from manip_il.cli.options import Given, command_line, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say, warn
from manip_il.errors import UsageError
from manip_il.evaluation.policy_folder import require_source
from manip_il.option import option
from manip_il.seeding import stream_seeds

if TYPE_CHECKING:
    from manip_il.evaluation.arm import Member
    from manip_il.evaluation.runner import Trial

AT_HELP = (
    "which rounds of a run count: end (all), labels, episodes, steps or seconds (up to what every run reached; seconds "
    "of collecting and fitting), or an amount, as in labels:5000"
)
_YAML = (".yaml", ".yml")


def _require_side(path: Path) -> None:
    if path.suffix not in _YAML:
        require_source(path)
    elif not path.is_file():
        raise UsageError(f"{path} does not exist; expected the YAML of a study, such as configs/studies/*.yaml")


@dataclass
class CompareOptions:
    """Compare two policies, runs, or folders of several training seeds, on the same test seeds; or run a whole study.

    Each side is an eval.json, a policy, a run of manip-il dagger, or a folder with such things named seed_0, seed_1
    and so on. Two eval.json are compared as they are; all else is evaluated first. Writes compare.json and report.html.

    One YAML in place of two sides is a study: every arm is run with several training seeds, all are tested on the same
    unseen seeds, and compared. It holds `common` and `arms` (options of manip-il dagger), training_seeds, eval,
    checkpoint, at, baseline and target. OUTPUT_DIR/ARM/seed_0, seed_1, ... are the runs; study.json and report.html the
    results.
    """

    example: ClassVar[str] = "manip-il compare runs/cloning runs/dagger --at=labels --output_dir=runs/compare"
    first: ClassVar[str] = "at eval.n_episodes suite output_dir resume training_seeds"
    sides: list[Path] = option(
        MISSING, "two sides, or the YAML of a study", positional=True, check=_require_side, free=True
    )
    checkpoint: Literal["best", "last"] = option("best", "of a run: best on validation, or the last round")
    at: str = option("end", AT_HELP)
    eval: common.TrialGroup = field(default_factory=common.TrialGroup)
    suite: str = common.suite_option()
    env: Given = common.env_given(of_policy=True)
    seed: int = option(0, "shifts the stream of test seeds, 0 to 1000", at_least=0, at_most=1000)
    training_seeds: int | None = option(
        None, "of a study, in place of the file's; a resumed one may have more", at_least=1, free=True
    )
    engine: common.EngineOptions = group(common.EngineOptions(), prefix="")
    trust: bool = common.trust_option()
    output: ResumableOutput = group(ResumableOutput(Path("runs/compare")), prefix="")

    def check(self) -> None:
        """Refuse what does not go together."""
        self.output.check()
        if self._is_study:
            return
        if len(self.sides) != 2 or any(side.suffix in _YAML for side in self.sides):
            raise UsageError(f"{len(self.sides)} sides are given; expected two, or the YAML of one study")
        left, right = self.sides
        if left.resolve() == right.resolve():
            raise UsageError(f"{left} is compared with itself; give two different ones")

    @property
    def _is_study(self) -> bool:
        return len(self.sides) == 1 and self.sides[0].suffix in _YAML

    def run(self) -> None:
        """Evaluate what is not evaluated yet, compare, print and write the answer."""
        if self._is_study:
            from manip_il.cli.study import Study

            Study(self.sides[0], self.engine, self.output, trust=self.trust).run(self, self.training_seeds)
        else:
            self._compare(*self.sides)

    def _compare(self, left: Path, right: Path) -> None:
        from manip_il.evaluation.arm import read_arm, require_pair
        from manip_il.evaluation.compare_report import compare_report, comparison_table
        from manip_il.evaluation.comparison import FILE_NAME, Comparison, seeds_facts
        from manip_il.evaluation.results import write_json
        from manip_il.evaluation.rounds import Rule
        from manip_il.evaluation.tables import print_table

        rule = Rule.parse(self.checkpoint, self.at)
        both = [read_arm(left), read_arm(right)]
        require_pair(*both)
        members = [member for arm in both for member in arm.members]
        warn(
            *(f"{one.name} is not finished: its {len(one.history)} rounds count" for one in members if not one.finished)
        )
        limit = rule.limit({member.name: member.history for member in members})
        arms = [arm.map(lambda member: member.select(rule, limit)) for arm in both]
        trial = self._trial([member for arm in arms for member in arm.members])
        with self.output.open(self) as folder:
            kept = f"every finished evaluation, in {folder}"
            with Stages(kept) as stages, self.engine.open() as engine:
                last = (trial, folder, engine, stages)
                arms = [arm.map(lambda one: one.measure(*last)) for arm in arms]
            comparison = Comparison(*arms)
            write_json(folder / FILE_NAME, comparison.file_json() | {"rule": rule.to_json(limit)})
            chosen = any(member.chosen for arm in arms for member in arm.members)
            facts = [*([rule.fact(limit)] if chosen else []), *seeds_facts(len(comparison.pairs))]
            report = compare_report(comparison, command_line("compare", self), facts, to_plain(self))
            report.write(folder / REPORT_FILE)
        print_table(comparison_table(comparison))
        say(*facts, comparison.verdict, f"result: {folder / FILE_NAME}", f"report: {folder / REPORT_FILE}")

    def _trial(self, members: Sequence[Member]) -> Trial | None:
        """Return the test to run, checked; None if all is evaluated already."""
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.evaluation.arm import common_env
        from manip_il.evaluation.comparison import require_same_episodes
        from manip_il.evaluation.results import compare_results
        from manip_il.evaluation.runner import Trial
        from manip_il.learn.checkpoint import Checkpoint

        if members[0].result is not None:
            first = members[0]
            for other in members[1:]:
                compare_results(first.test, other.test, (first.name, other.name))
                require_same_episodes(first.name, first.test, other.name, other.test)
                warn(*compare_fingerprints(first.name, first.test.fingerprint, other.name, other.test.fingerprint))
            return None
        policies = {member.name: member.policy for member in members if member.policy is not None}
        seeds = stream_seeds("test", self.eval.n_episodes, self.seed)
        env = common_env(members, lambda policy: common.env_config(self.env, Checkpoint.open(policy).origin))
        trial = Trial.of(env, seeds, self.suite, policies.values(), self.trust)
        check_policies(policies, trial)
        return trial
