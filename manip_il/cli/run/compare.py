"""Run `manip-il compare`: two policies or runs on the same seeds, or a study."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from manip_il import checks
from manip_il.algorithms.config import check_labels
from manip_il.algorithms.imitation import check_inputs
from manip_il.cli.common_options import EngineOptions
from manip_il.cli.compare import CompareOptions, ComparisonOptions, StudyFile
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.outputs import REPORT_FILE, publish
from manip_il.cli.parsing import from_layers, from_yaml
from manip_il.cli.progress import Stages, say, warn
from manip_il.cli.run.dagger import dagger_config, run_dagger
from manip_il.collect.inputs import env_config
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.evaluation.comparison import FILE_NAME, Study
from manip_il.evaluation.eval_report import compare_report
from manip_il.evaluation.measuring import measure_sides
from manip_il.evaluation.rounds import Rule
from manip_il.evaluation.side import Side, read_side, require_pair, require_same_env, select_rounds
from manip_il.learn.checkpoint import Checkpoint
from manip_il.worlds.config import EnvConfig

_YAML = (".yaml", ".yml")
_OF_STUDY = ("seed", "output_dir", "resume", "overwrite", "workers", "engine")  # options of a run that the study sets


def run_compare(options: CompareOptions) -> None:
    """Run the missing runs and evaluations, compare, print and write the result."""
    match options.sides:
        case [file] if file.suffix in _YAML:
            _refuse(options, f"cannot be combined with a study; set them in {file}", "eval", "checkpoint", "at", "env")
            _run_study(options, file)
        case [left, right]:
            _compare(options, left, right)
        case _:
            raise UsageError(f"{len(options.sides)} sides are given; expected two, or the YAML file of one study")


def _refuse(options: CompareOptions, why: str, *names: str) -> None:
    """Raise `UsageError` for options that have no effect, if they are given."""
    plain = CompareOptions(sides=options.sides)
    for name in names:
        if getattr(options, name) != getattr(plain, name):
            raise UsageError(f"options of {name} {why}")


def _run_study(options: CompareOptions, path: Path) -> None:
    plan = read_plan(path, options.training_seeds, options.trust)
    with options.open(path, saved=plan.file) as folder:
        run_plan(plan, folder, options)
        sides = [read_side(folder / name, name) for name in plan.arms]
        title = f"Study: {path.stem}"
        _finish(options, plan.file, sides, plan.envs, plan.baseline, title, target=plan.file.target)


def _compare(options: CompareOptions, left: Path, right: Path) -> None:
    both = (read_side(left), read_side(right))
    require_pair(*both)
    first, *others = [member for side in both for member in side.members]
    envs = dict[str, EnvConfig]()
    if first.result:
        _refuse(options, "change nothing for two evaluations; give two policies", "eval", "env", "suite", "seed")
        for other in others:
            warn(*compare_fingerprints(first.name, first.test.fingerprint, other.name, other.test.fingerprint))
    else:
        envs = dict.fromkeys((side.name for side in both), _env(options, both))
    with options.lock() as prepare:
        _finish(options, options, both, envs, both[0].name, f"{left} against {right}", prepare)


def _finish(
    options: CompareOptions,
    how: ComparisonOptions,
    sides: Sequence[Side],
    envs: Mapping[str, EnvConfig],
    baseline: str | None,
    title: str,
    prepare: Callable[[], None] | None = None,
    **target: float,
) -> None:
    """Run the tests, write the result and the report, print the table and the verdict.

    how: the options to store. envs: of each side; none if the sides are evaluations.
    """
    folder = options.output_dir
    rule, sides = select_rounds(Rule(how.checkpoint, how.at), sides)
    with Stages(f"every finished episode, in {folder}", prepare) as stages, options.open_engine() as engine:
        if envs:
            sides = measure_sides(
                sides,
                envs,
                folder,
                episodes=how.eval.n_episodes,
                suite=options.suite,
                seed=options.seed,
                trust=options.trust,
                engine=engine,
                progress=stages,
            )
        study = Study(sides, baseline, rule, **target)
        if not envs:
            stages.started()
    page = compare_report(study, title)
    publish(folder / FILE_NAME, study.to_json(), [study.table()], study.verdict, *study.facts, page=page, options=how)


def _env(options: CompareOptions, sides: Sequence[Side]) -> EnvConfig:
    """Return the test environment of all sides: that of the runs, else that of the policies."""
    given = {name: value for name, value in options.env.items() if value is not None}
    members = [member for side in sides for member in side.members]
    if runs := [member for member in members if member.history]:
        own = [given.pop(name, None) for name in ("robot", "task", "object")]
        return require_same_env({run.name: replace(run.validation.env(*own), **given) for run in runs})
    origins = {one.name: Checkpoint.open(one.policy).origin for one in members if one.policy is not None}
    return require_same_env({name: env_config(given, origin) for name, origin in origins.items()})


class StudyPlan(NamedTuple):
    """A checked study: options and environment of every arm, and the arm to compare others with, if any."""

    file: StudyFile
    arms: Mapping[str, DaggerOptions]
    envs: Mapping[str, EnvConfig]
    baseline: str | None


def run_plan(plan: StudyPlan, root: Path, engine: EngineOptions) -> None:
    """Run the missing runs, seed by seed, so that a study that is stopped early has runs of every arm."""
    runs = [(name, seed) for seed in range(plan.file.training_seeds) for name in plan.arms]
    for number, (name, seed) in enumerate(runs, start=1):
        output = root / name / f"seed_{seed}"
        if not (output / REPORT_FILE).is_file():  # the file that a run writes last
            say(f"run {number} of {len(runs)}: {name}, training seed {seed}")
            arm = plan.arms[name]
            run_dagger(
                replace(
                    arm,
                    settings=arm.settings | {"seed": seed},
                    output_dir=output,
                    resume=True,
                    workers=engine.workers,
                    engine=engine.engine,
                )
            )


def read_plan(path: Path, training_seeds: int | None = None, trust: bool = False) -> StudyPlan:
    """Return the study in `path`; raises a one-line `UsageError` if something is invalid.

    training_seeds: replaces the number in the file. trust: `--trust` for every run.
    """
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
            config = dagger_config(arms[name])
            check_labels(config)
            check_inputs(config)
            envs[name] = config.env
        except ManipError as error:
            raise UsageError(f"{path}: arm {name!r}: {error}") from error
    if file.baseline is not None and file.baseline not in envs:
        raise UnknownName("baseline", file.baseline, envs)
    if file.baseline is None and len({env.task for env in envs.values()}) > 1:
        return StudyPlan(file, arms, envs, None)
    require_same_env(envs)
    return StudyPlan(file, arms, envs, file.baseline or next(iter(envs)))
