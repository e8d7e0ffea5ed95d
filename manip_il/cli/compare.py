"""`manip-il compare`: two policies or runs on the same seeds, with the confidence in their difference, or a study.

A study runs `manip-il dagger` with several sets of options (its arms), each with the same training seeds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

from manip_il import checks
from manip_il.cli.common_options import OF_POLICY, EngineOptions, Tested, Trusting, env_config
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.options import Given, Open, command_line, given, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput, publish
from manip_il.cli.parsing import from_layers, from_yaml
from manip_il.cli.progress import Stages, say, warn
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.learn.checkpoint import Checkpoint
from manip_il.option import Seeded, option
from manip_il.seeding import MAX_SEED, stream_seeds
from manip_il.tasks.config import EnvConfig

if TYPE_CHECKING:
    from manip_il.evaluation.runner import Trial
    from manip_il.evaluation.side import Side

_YAML = (".yaml", ".yml")
_OF_STUDY = ("seed", "output_dir", "resume", "overwrite", "workers", "engine")  # options of a run that the study sets


@dataclass(frozen=True)
class TrialGroup:
    """`--eval.*`: the test episodes."""

    n_episodes: int = option(500, "test episodes", at_least=1, grows=True)


@dataclass(frozen=True, kw_only=True)
class ComparisonOptions:
    """Which rounds of the runs are compared, and on how many episodes."""

    checkpoint: Literal["best", "last"] = option("best", "round of a run to test: the best on validation, or the last")
    at: Literal["end", "labels", "episodes", "steps", "seconds"] = option(
        "end",
        "which rounds of a run count: all (end), or those within the number of labels, episodes, steps or seconds (of "
        "collecting and fitting) that every run reached",
    )
    eval: TrialGroup = field(default_factory=TrialGroup)


@dataclass(frozen=True)
class StudyFile(ComparisonOptions):
    """Content of a study's YAML file.

    common: options of `manip-il dagger` that all arms share. arms: name -> options in which an arm differs. Arms of
    different tasks are not compared.
    """

    common: Open = field(default_factory=dict[str, Any])
    arms: Open = field(default_factory=dict[str, Any])
    training_seeds: int = option(3, "runs of every arm, one per seed", at_least=1, at_most=MAX_SEED, grows=True)
    baseline: str | None = option(None, "the arm to compare others with; by default the first")
    target: float = option(0.95, "report what it costs to reach this validation success", at_least=0.0, at_most=1.0)


@dataclass(frozen=True)
class CompareOptions(ComparisonOptions, Tested, Seeded, Trusting):
    """Compare two policies, runs, or folders of several training seeds on the same test seeds; or run a whole study.

    Each side is an eval.json, a policy, a run of manip-il dagger, or a folder with one of these per training seed
    (seed_0, seed_1, ...). Two eval.json files are compared directly; other sides are evaluated first. Writes
    compare.json and report.html.

    One YAML file instead of two sides is a study: every arm (a set of options) is trained with several seeds, tested
    on the same unseen seeds, and compared. The file holds `common` and `arms` (options of manip-il dagger),
    training_seeds, eval, checkpoint, at, baseline and target. OUTPUT_DIR/ARM/seed_0, seed_1, ... are the runs.
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
    env: Given = given(EnvConfig, **OF_POLICY)
    training_seeds: int | None = option(
        None, "training seeds of a study, if not its file's; may grow with --resume=true", at_least=1, free=True
    )
    engine: EngineOptions = group(EngineOptions(), prefix="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/compare")), prefix="")

    def run(self) -> None:
        """Run the missing runs and evaluations, compare, print and write the result."""
        match self.sides:
            case [file] if file.suffix in _YAML:
                self._refuse(f"cannot be combined with a study; set them in {file}", "eval", "checkpoint", "at", "env")
                self._run_study(file)
            case [left, right]:
                self._compare(left, right)
            case _:
                raise UsageError(f"{len(self.sides)} sides are given; expected two, or the YAML file of one study")

    def _refuse(self, why: str, *names: str) -> None:
        """Raise `UsageError` for options that have no effect, if they are given."""
        plain = CompareOptions(sides=self.sides)
        for name in names:
            if getattr(self, name) != getattr(plain, name):
                raise UsageError(f"options of {name} {why}")

    def _run_study(self, path: Path) -> None:
        from manip_il.evaluation.rounds import Rule
        from manip_il.evaluation.side import read_side, select_rounds

        plan = read_plan(path, self.training_seeds, self.trust)
        file = plan.file
        with self.output.open(file, path) as folder:
            plan.run(folder, self.engine)
            rule, sides = select_rounds(
                Rule(file.checkpoint, file.at), [read_side(folder / name, name) for name in plan.arms]
            )
            trials = self._trials(sides, plan.envs, file.eval.n_episodes)
            self._report(sides, trials, folder, (plan.baseline, rule, file.target), f"Study: {path.stem}", file)

    def _compare(self, left: Path, right: Path) -> None:
        from manip_il.evaluation.comparison import Study
        from manip_il.evaluation.rounds import Rule
        from manip_il.evaluation.side import read_side, require_pair, select_rounds

        both = (read_side(left), read_side(right))
        require_pair(*both)
        rule, both = select_rounds(Rule(self.checkpoint, self.at), both)
        first, *others = [member for side in both for member in side.members]
        trials: Sequence[Trial] = ()
        if first.result:
            self._refuse("change nothing for two evaluations; give two policies", "eval", "env", "suite", "seed")
            Study(both, both[0].name)  # raises unless they can be compared
            for other in others:
                warn(*compare_fingerprints(first.name, first.test.fingerprint, other.name, other.test.fingerprint))
        else:
            envs = dict.fromkeys((side.name for side in both), self._env(both))
            trials = self._trials(both, envs, self.eval.n_episodes)
        with self.output.open(self) as folder:
            self._report(both, trials, folder, (both[0].name, rule), f"{left} against {right}", self)

    def _env(self, sides: Sequence[Side]) -> EnvConfig:
        """Return the test environment of all sides: that of the runs, else that of the policies."""
        from manip_il.evaluation.side import require_same_env

        given = {name: value for name, value in self.env.items() if value is not None}
        members = [member for side in sides for member in side.members]
        if runs := [member for member in members if member.history]:
            own = [given.pop(name, None) for name in ("robot", "task", "object")]
            return require_same_env({run.name: replace(run.validation.env(*own), **given) for run in runs})
        origins = {one.name: Checkpoint.open(one.policy).origin for one in members if one.policy is not None}
        return require_same_env({name: env_config(given, origin) for name, origin in origins.items()})

    def _trials(self, sides: Sequence[Side], envs: Mapping[str, EnvConfig], n_episodes: int) -> list[Trial]:
        """Return the test of each side; raises, before any episode runs, if a policy does not fit its environment."""
        from manip_il.cli.inputs import check_policy
        from manip_il.evaluation.runner import Trial

        policies = list[Path]()
        for side in sides:
            for policy in side.policies:
                check_policy(Checkpoint.open(policy), envs[side.name], trust=self.trust)
                policies.append(policy)
        seeds = stream_seeds("test", n_episodes, self.seed)
        return [Trial.of(envs[side.name], seeds, self.suite, policies, self.trust) for side in sides]

    def _report(
        self,
        sides: Sequence[Side],
        trials: Sequence[Trial],
        folder: Path,
        how: tuple[Any, ...],
        title: str,
        config: ComparisonOptions,
    ) -> None:
        """Run the tests, write the result and the report, print the tables and the verdict.

        trials: of each side; none if they are evaluations. how: what `Study` takes after its sides.
        """
        from manip_il.evaluation.comparison import FILE_NAME, Study
        from manip_il.evaluation.eval_report import compare_report

        if trials:
            with Stages(f"every finished episode, in {folder}") as stages, self.engine.open() as engine:
                pairs = zip(sides, trials, strict=True)
                sides = [side.measure(trial, folder, engine, stages) for side, trial in pairs]
        study = Study(tuple(sides), *how)
        page = compare_report(study, title, command_line(), to_plain(config))
        publish(folder / FILE_NAME, study.to_json(), [study.table()], study.verdict, *study.facts, page=page)


class StudyPlan(NamedTuple):
    """A checked study: the options and the environment of every arm, and the arm to compare others with, if any."""

    file: StudyFile
    arms: Mapping[str, DaggerOptions]
    envs: Mapping[str, EnvConfig]
    baseline: str | None

    def run(self, root: Path, engine: EngineOptions) -> None:
        """Run the missing runs, seed by seed, so that a study that is stopped early has runs of every arm."""
        runs = [(name, seed) for seed in range(self.file.training_seeds) for name in self.arms]
        for number, (name, seed) in enumerate(runs, start=1):
            output = ResumableOutput(root / name / f"seed_{seed}", resume=True)
            if not (output.output_dir / REPORT_FILE).is_file():  # the file that a run writes last
                say(f"run {number} of {len(runs)}: {name}, training seed {seed}")
                options = self.arms[name]
                replace(options, settings=options.settings | {"seed": seed}, output=output, engine=engine).run()


def read_plan(path: Path, training_seeds: int | None = None, trust: bool = False) -> StudyPlan:
    """Return the study in `path`; raises a one-line `UsageError` if something is invalid.

    training_seeds: replaces the number in the file. trust: `--trust` for every run.
    """
    from manip_il.evaluation.side import require_same_env

    file = from_yaml(path, StudyFile)
    file = replace(file, training_seeds=training_seeds or file.training_seeds)
    if not file.arms:
        raise UsageError(f"{path}: arms is empty; expected a mapping of names to options of manip-il dagger")
    arms, envs = dict[str, DaggerOptions](), dict[str, EnvConfig]()
    for name, own in file.arms.items():
        try:
            checks.name("its name, which becomes a folder,", name)
            layers = [("common", file.common), ("its options", own)]
            if found := next((one for one in _OF_STUDY for _, tree in layers if one in (tree or {})), None):
                raise UsageError(f"{found} is set by the study for every run; remove it")
            arms[name] = replace(from_layers(DaggerOptions, layers), trust=trust)
            envs[name] = arms[name].config().env
        except ManipError as error:
            raise UsageError(f"{path}: arm {name!r}: {error}") from error
    if file.baseline is None and len({env.task for env in envs.values()}) > 1:
        return StudyPlan(file, arms, envs, None)
    require_same_env(envs)
    if file.baseline is not None and file.baseline not in envs:
        raise UnknownName("baseline", file.baseline, envs)
    return StudyPlan(file, arms, envs, file.baseline or next(iter(envs)))
