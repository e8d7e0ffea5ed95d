"""`manip-il compare`: two policies or runs on the same seeds, with the confidence in their difference, or a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from manip_il.cli.common_options import OF_POLICY, EngineOptions, Tested, TrialGroup, Trusting, env_config
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say, warn
from manip_il.errors import UsageError
from manip_il.option import Seeded, option
from manip_il.tasks.config import EnvConfig

if TYPE_CHECKING:
    from manip_il.evaluation.arm import Arm
    from manip_il.evaluation.comparison import Study
    from manip_il.evaluation.runner import Trial

_YAML = (".yaml", ".yml")


@dataclass(frozen=True)
class CompareOptions(Tested, Seeded, Trusting):
    """Compare two policies, runs, or folders of several training seeds on the same test seeds; or run a whole study.

    Each side is an eval.json, a policy, a run of manip-il dagger, or a folder of these named seed_0, seed_1, ...
    Two eval.json files are compared directly; other sides are evaluated first. Writes compare.json and report.html.

    One YAML file instead of two sides is a study: every arm is run with several training seeds, tested on the same
    unseen seeds, and compared. It holds `common` and `arms` (options of manip-il dagger), training_seeds, eval,
    checkpoint, at, baseline and target. OUTPUT_DIR/ARM/seed_0, seed_1, ... are the runs.
    """

    example: ClassVar[str] = "manip-il compare runs/cloning runs/dagger --at=labels --output_dir=runs/compare"
    first: ClassVar[str] = "at eval.n_episodes suite output_dir resume training_seeds"
    sides: list[Path] = option(
        MISSING,
        "two sides, each an eval.json, a policy or a run; or the YAML file of a study",
        positional=True,
        exists="",
        free=True,
    )
    checkpoint: Literal["best", "last"] = option("best", "which round of a run: the best on validation, or the last")
    at: Literal["end", "labels", "episodes", "steps", "seconds"] = option(
        "end",
        "which rounds of a run count: end (all), or those within the labels, episodes, steps or seconds (of collecting "
        "and fitting) that every run reached",
    )
    eval: TrialGroup = field(default_factory=TrialGroup)
    env: Given = given(EnvConfig, **OF_POLICY)
    training_seeds: int | None = option(
        None, "seeds of a study, instead of the file's; a resumed study may have more", at_least=1, free=True
    )
    engine: EngineOptions = group(EngineOptions(), prefix="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/compare")), prefix="")

    def run(self) -> None:
        """Run the missing evaluations, compare, print and write the result."""
        match self.sides:
            case [file] if file.suffix in _YAML:
                self._run_study(file)
            case [left, right]:
                self._compare(left, right)
            case _:
                raise UsageError(f"{len(self.sides)} sides are given; expected two, or the YAML file of one study")

    def _run_study(self, path: Path) -> None:
        from manip_il.cli.study import read_plan, run_arms
        from manip_il.evaluation.arm import select_rounds
        from manip_il.evaluation.comparison import Study
        from manip_il.evaluation.rounds import Rule

        plan = read_plan(path, self.training_seeds, self.trust)
        file = plan.file
        with self.output.open(file) as folder:
            rule, arms = select_rounds(Rule(file.checkpoint, file.at), run_arms(plan, folder, self.engine))
            trials = [self._trial(plan.envs[arm.name], [arm], file.eval.n_episodes) for arm in arms]
            study = Study(self._measure(arms, trials, folder), plan.baseline, rule, file.target)
            result = study.arms[0].members[0].test
            what = f"{result.robot} {result.task}" if plan.baseline else result.robot
            self._report(study, folder, f"Study: {what}, {path.stem}", to_plain(file))

    def _compare(self, left: Path, right: Path) -> None:
        from manip_il.data.fingerprint import compare_fingerprints
        from manip_il.evaluation.arm import read_arm, require_pair, select_rounds
        from manip_il.evaluation.comparison import Study
        from manip_il.evaluation.rounds import Rule

        both = (read_arm(left), read_arm(right))
        require_pair(*both)
        rule, both = select_rounds(Rule(self.checkpoint, self.at), both)
        first, *others = [member for arm in both for member in arm.members]
        trial = None if first.result else self._trial(self._env(both), both, self.eval.n_episodes)
        if trial is None:
            assert Study(both, both[0].name, rule).comparisons  # raises unless they can be compared
            for other in others:
                warn(*compare_fingerprints(first.name, first.test.fingerprint, other.name, other.test.fingerprint))
        with self.output.open(self) as folder:
            measured = self._measure(both, [trial] * 2, folder) if trial else both
            study, test = Study(measured, measured[0].name, rule), measured[0].members[0].test
            self._report(study, folder, f"{left} against {right}: {test.robot} {test.task}", to_plain(self))

    def _env(self, arms: Sequence[Arm]) -> EnvConfig:
        """Return the test environment of all arms: that of the runs, else that of the policies."""
        from manip_il.evaluation.arm import require_same_env
        from manip_il.learn.checkpoint import Checkpoint

        given = {name: value for name, value in self.env.items() if value is not None}
        members = [member for arm in arms for member in arm.members]
        if runs := [member for member in members if member.history]:
            return require_same_env({run.name: replace(run.env(given.get("task")), **given) for run in runs})
        origins = {one.name: Checkpoint.open(one.policy).origin for one in members if one.policy is not None}
        return require_same_env({name: env_config(given, origin) for name, origin in origins.items()})

    def _trial(self, env: EnvConfig, arms: Sequence[Arm], n_episodes: int) -> Trial:
        """Return the test of these arms; raises, before any episode runs, if a policy does not fit it."""
        from manip_il.cli.inputs import check_policy
        from manip_il.evaluation.runner import Trial
        from manip_il.learn.checkpoint import Checkpoint
        from manip_il.seeding import stream_seeds

        policies = [one.policy for arm in arms for one in arm.members if one.policy is not None]
        for policy in policies:
            check_policy(Checkpoint.open(policy), env, trust=self.trust)
        return Trial.of(env, stream_seeds("test", n_episodes, self.seed), self.suite, policies, self.trust)

    def _measure(self, arms: Sequence[Arm], trials: Sequence[Trial], folder: Path) -> tuple[Arm, ...]:
        """Return the arms with the results of their tests."""
        with Stages(f"every finished episode, in {folder}") as stages, self.engine.open() as engine:
            pairs = zip(arms, trials, strict=True)
            return tuple(arm.measure(trial, folder, engine, stages) for arm, trial in pairs)

    def _report(self, study: Study, folder: Path, title: str, config: Mapping[str, Any]) -> None:
        """Write the result and the report, print the tables and the verdict."""
        from manip_il.evaluation.comparison import FILE_NAME
        from manip_il.evaluation.eval_report import compare_report
        from manip_il.evaluation.results import write_json
        from manip_il.evaluation.tables import print_table

        write_json(folder / FILE_NAME, study.to_json())
        compare_report(study, title, command_line(), config).write(folder / REPORT_FILE)
        for table in study.tables:
            print_table(table)
        say(study.verdict, *study.facts, f"result: {folder / FILE_NAME}", f"report: {folder / REPORT_FILE}")
