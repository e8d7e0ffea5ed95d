"""Run `manip-il dagger`: roll out, label, aggregate, refit, and repeat.

Run `manip-il demo`: demonstrations, cloning, DAgger, and a report that compares them.

Run `manip-il compare`: two policies or runs on the same seeds, or a study.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from manip_il import checks
from manip_il.algorithms.config import ALGORITHMS, RunConfig, check_labels
from manip_il.algorithms.imitation import check_inputs, dagger, run_config
from manip_il.algorithms.results import best_result, validation_report
from manip_il.algorithms.run import Run
from manip_il.cli.common_options import EngineOptions
from manip_il.cli.evaluate import CompareOptions, ComparisonOptions, StudyFile
from manip_il.cli.imitation import DaggerOptions, DemoOptions
from manip_il.cli.outputs import Stages, about, publish, say, say_next
from manip_il.cli.parsing import from_layers, from_yaml
from manip_il.collect.inputs import env_config, path_options
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.errors import ManipError, UnknownName, UsageError, warn
from manip_il.evaluation.comparison import FILE_NAME, Comparison, Study
from manip_il.evaluation.eval_report import compare_report, run_report, success_table
from manip_il.evaluation.film import collect_films, film_episode
from manip_il.evaluation.measuring import episode_hold, measure_sides, open_driver
from manip_il.evaluation.report import REPORT_FILE, Film
from manip_il.evaluation.side import (
    Member,
    Rule,
    Side,
    read_member,
    read_side,
    require_pair,
    require_same_env,
    select_rounds,
)
from manip_il.evaluation.suites import varied
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.names import CNN
from manip_il.sim.events import standard_in
from manip_il.worlds.config import EnvConfig


def run_dagger(options: DaggerOptions) -> None:
    """Run all rounds, or continue them."""
    config, folder = dagger_config(options), options.output_dir
    kept = f"every finished episode and round, in {folder}"
    with (
        options.lock() as prepare,
        Stages(kept, prepare) as stages,
        options.open_engine() as engine,
    ):
        results = dagger(folder, config, workers=engine, progress=stages)
        kind = ALGORITHMS[config.method]
        page = validation_report(
            folder,
            f"{kind} on {config.env.robot} {config.env.task}",
            "cloning" if config.start is None else "the policy given",
            {result.number: result.validation for result in results},
        )
        replace(page, **about(options)).write(folder)
    if (folder / "dataset").is_dir():
        say(f"labels of all rounds as one dataset: {folder / 'dataset'}")
    say_best(folder, path_options(vars(config.env)))


def say_best(folder: Path, words: Sequence[str] = ()) -> None:
    """Print where a run's report and best policy are, and how to evaluate that policy.

    Args:
        folder: Folder of the run.
        words: Options that the policy does not store.
    """
    best = folder / "best" / "pretrained_model"
    say(f"report: {folder / REPORT_FILE}", f"best policy: {best}")
    say_next("eval", f"--policy.path={best}", *words, f"--output_dir={folder}/test")


def dagger_config(options: DaggerOptions) -> RunConfig:
    """Return the configuration of the run; raises if options contradict each other."""
    env = env_config(options.env)
    fit = FitConfig(**options.fit, trust=options.trust)
    sees = fit.start is None and fit.kind == CNN and fit.takes_images
    if options.cameras or sees:
        cameras = options.camera_config(env)
    else:
        cameras = fit.start and fit.start.cameras
    return run_config(
        env,
        query=options.query,
        method=options.method,
        conditions=varied(options.vary, env, sees=cameras is not None),
        fit=fit,
        cameras=cameras,
        datasets=tuple(options.dataset.root),
        start=fit.start and fit.start.path,
        **options.settings,
    )


ENOUGH = 1.25  # demonstrations to record, relative to the number that should give enough labels


def run_demo(options: DemoOptions) -> None:
    """Run the missing steps, print the table, write the report."""
    config = dagger_config(
        DaggerOptions(env=options.env, settings=options.settings, fit=options.fit)
    )
    kept = f"every finished episode, round and evaluation, in {options.output_dir}"
    with options.open() as folder, Stages(kept) as stages, options.open_engine() as engine:
        sides = _measure(options, config, folder, engine, stages)
        films = _film(sides, config, stages)
    disturbed = [Side.of(side.name, side.disturbed) for side in sides if side.disturbed]
    verdict, *facts = (
        prefix + Comparison(tested[place], tested[-1]).verdict
        for prefix, tested in (("", sides), ("Disturbed: ", disturbed))
        for place in (1, 2)  # round 0, then cloning from as many labels
    )
    if config.disturbed_share:
        facts.append(
            f"{config.disturbed_share:.0%} of DAgger's rollouts and all demonstrations of the"
            " second cloned policy were disturbed."
        )
    page = run_report(
        sides,
        [Side("DAgger", (read_member(folder / "dagger"),))],
        films,
        title=f"Demo: {config.env.robot} {config.env.task}",
        verdict=verdict,
        facts=tuple(facts),
        fingerprint=sides[-1].results[0].fingerprint,
        **about(options),
    )
    path = page.write(folder)
    success_table(sides).print()
    say(verdict, *facts, f"report: {path}")
    say_next(
        "eval",
        f"--policy.path={sides[-1].members[0].policy}",
        "--eval.films=3",
        f"--output_dir={folder}_eval",
    )


def _measure(
    options: DemoOptions, config: RunConfig, folder: Path, engine: Engine, stages: Stages
) -> list[Side]:
    """Run DAgger, clone disturbed demonstrations with as many labels, and test both, round 0 and
    the expert (policy None).
    """
    results = dagger(folder / "dagger", config, workers=engine, progress=stages)
    first, best = results[0], best_result(results)
    most = results[-1].labels
    # disturbed as DAgger's rollouts are, so that the difference is the algorithm's
    conditions = (standard_in(config.conditions),) if config.disturbed_share else config.conditions
    disturbed = replace(config, label_budget=most, conditions=conditions)
    run = Run(disturbed, folder / f"cloning_{most}", engine, stages)
    more = run.demonstrations(math.ceil(ENOUGH * config.demonstrations * most / first.labels))
    policy = run.fit([more]).path
    contestants = (
        ("expert", None, None),
        ("cloning", first.policy, first.labels),
        ("cloning, disturbed, as many labels", policy, more.labels),
        (f"DAgger (round {best.number})", best.policy, best.labels),
    )
    sides = [Side(name, (Member(Path(name), policy=path),), n) for name, path, n in contestants]
    envs = dict.fromkeys((side.name for side in sides), config.env)
    nominal, knocked = (
        measure_sides(
            sides,
            envs,
            folder / suite,
            episodes=count,
            suite=suite,
            seed=config.seed,
            engine=engine,
            progress=stages,
        )
        for suite, count in (
            ("nominal", options.test_episodes),
            ("knocked", options.disturbed_episodes),
        )
    )
    return [
        replace(side, disturbed=other.results[0])
        for side, other in zip(nominal, knocked, strict=True)
    ]


def _film(sides: Sequence[Side], config: RunConfig, stages: Stages) -> list[Film]:
    """Film every policy on the first seed on which DAgger succeeds and cloning fails, else on
    the first seed.
    """
    cloned, best = sides[1].results[0].episodes, sides[-1].results[0].episodes
    won = {episode.seed for episode in best if episode.success}
    seed = next((one.seed for one in cloned if not one.success and one.seed in won), cloned[0].seed)

    def films() -> Iterator[Film]:
        for side in sides:
            env, driver, _ = open_driver(side.members[0].policy, config.env)
            [episode] = RolloutJob(env, driver, episode_hold(env), label="last").run([seed])
            caption = f"{'success' if episode.success else 'failure'}, seed {seed}"
            yield film_episode(env, episode, side.name, caption)

    stages.start("films", len(sides))
    return collect_films(films(), stages)


_YAML = (".yaml", ".yml")
# options of a run that the study sets
_OF_STUDY = ("seed", "output_dir", "resume", "overwrite", "workers", "engine")


def run_compare(options: CompareOptions) -> None:
    """Run the missing runs and evaluations, compare, print and write the result."""
    match options.sides:
        case [file] if file.suffix in _YAML:
            _refuse(
                options,
                f"cannot be combined with a study; set them in {file}",
                "eval",
                "checkpoint",
                "at",
                "env",
            )
            _run_study(options, file)
        case [left, right]:
            _compare(options, left, right)
        case _:
            raise UsageError(
                f"{len(options.sides)} sides are given; expected two, or the YAML file of one study"
            )


def _refuse(options: CompareOptions, why: str, *names: str) -> None:
    """Raise `UsageError` for options that have no effect, if they are given."""
    plain = CompareOptions(sides=options.sides)
    for name in names:
        if getattr(options, name) != getattr(plain, name):
            raise UsageError(f"options of {name} {why}")


def _run_study(options: CompareOptions, path: Path) -> None:
    plan = read_plan(path, options.training_seeds, options.trust)
    with options.open(plan.file) as folder:
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
        _refuse(
            options,
            "change nothing for two evaluations; give two policies",
            "eval",
            "env",
            "suite",
            "seed",
        )
        for other in others:
            warn(
                *compare_fingerprints(
                    first.name, first.test.fingerprint, other.name, other.test.fingerprint
                )
            )
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
    with (
        Stages(f"every finished episode, in {folder}", prepare) as stages,
        options.open_engine() as engine,
    ):
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
    publish(
        folder / FILE_NAME,
        study.to_json(),
        [study.table()],
        study.verdict,
        *study.facts,
        page=page,
        options=how,
    )


def _env(options: CompareOptions, sides: Sequence[Side]) -> EnvConfig:
    """Return the test environment of all sides: that of the runs, else that of the policies."""
    given = {name: value for name, value in options.env.items() if value is not None}
    members = [member for side in sides for member in side.members]
    if runs := [member for member in members if member.history]:
        own = [given.pop(name, None) for name in ("robot", "task", "object")]
        return require_same_env(
            {run.name: replace(run.validation.env(*own), **given) for run in runs}
        )
    origins = {
        one.name: Checkpoint.open(one.policy).origin for one in members if one.policy is not None
    }
    return require_same_env({name: env_config(given, origin) for name, origin in origins.items()})


class StudyPlan(NamedTuple):
    """A study whose options have been checked.

    Attributes:
        file: The study's file.
        arms: Name of an arm -> its options.
        envs: Name of an arm -> its environment.
        baseline: The arm that the others are compared with; None if the arms have different tasks.
    """

    file: StudyFile
    arms: Mapping[str, DaggerOptions]
    envs: Mapping[str, EnvConfig]
    baseline: str | None


def run_plan(plan: StudyPlan, root: Path, engine: EngineOptions) -> None:
    """Run those runs of a study that are missing.

    They are run seed by seed, so that a study that is stopped early has runs of every arm.

    Args:
        plan: The study.
        root: Folder of the study, with one folder per arm and training seed.
        engine: How many workers run the episodes, and where.
    """
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
    """Return the study in a file.

    Args:
        path: The YAML file.
        training_seeds: Number of training seeds, by default that in the file.
        trust: Whether every run may load models and code that a checkpoint names.

    Raises:
        UsageError: if something in the file is invalid; the message has one line.
    """
    file = from_yaml(path, StudyFile)
    file = replace(file, training_seeds=training_seeds or file.training_seeds)
    if not file.arms:
        raise UsageError(
            f"{path}: arms is empty; expected a mapping of names to options of manip-il dagger"
        )
    arms, envs = dict[str, DaggerOptions](), dict[str, EnvConfig]()
    for name, own in file.arms.items():
        try:
            checks.name("its name, which becomes a folder,", name)
            layers = [("common", file.common), ("its options", own)]
            if found := next(
                (one for one in _OF_STUDY for _, tree in layers if one in (tree or {})), None
            ):
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
