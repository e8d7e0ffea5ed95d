"""Run `manip-il dagger`: roll out, label, aggregate, refit, and repeat."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from manip_il.algorithms.config import ALGORITHMS, RunConfig, check_labels
from manip_il.algorithms.results import Result, best_result
from manip_il.algorithms.run import Run
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.outputs import REPORT_FILE, write_page
from manip_il.cli.progress import Stages, say, say_next
from manip_il.cli.run.inputs import check_given, env_config, env_options, round_policy
from manip_il.collect.query import parse_query
from manip_il.collect.workers import Engine
from manip_il.data.atomic import write_json
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.eval_report import run_report
from manip_il.evaluation.side import Side, read_member
from manip_il.evaluation.suites import varied
from manip_il.evaluation.tables import CLONING, DAGGER
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_fingerprint


def run_dagger(options: DaggerOptions) -> None:
    """Run all rounds, or continue them."""
    config = dagger_config(options)
    with options.output.open(options) as folder:
        kept = f"every finished episode and round, in {folder}"
        with Stages(kept) as stages, options.engine.open() as engine:
            engine.warm_up(learned=True)
            results = run_rounds(config, folder, engine, stages)
        _report(options, config, results, folder)
    if (folder / "dataset").is_dir():
        say(f"labels of all rounds as one dataset: {folder / 'dataset'}")
    say_best(folder, config.env)


def say_best(folder: Path, env: EnvConfig) -> None:
    """Print where a run's report and best policy are, and how to evaluate that."""
    best = folder / "best" / "pretrained_model"
    say(f"report: {folder / REPORT_FILE}", f"best policy: {best}")
    say_next("eval", f"--policy.path={best}", *env_options(env), f"--output_dir={folder}/test")


def dagger_config(options: DaggerOptions) -> RunConfig:
    """Return the configuration of the run; raises if options contradict each other, or do not fit the inputs."""
    policy, start = round_policy(options.fit.get("policy", {}))
    observation, env = options.fit.get("observation"), env_config(options.env)
    sees = policy.get("type") == "cnn" and observation != "state"
    cameras = options.camera_config(env) if options.cameras or sees else None
    if start is not None:
        checkpoint = Checkpoint.open(start)
        observation, cameras = observation or checkpoint.observation, cameras or checkpoint.cameras
    config = RunConfig(
        env=env,
        method=options.method,
        conditions=varied(options.vary, env, sees=cameras is not None),
        fit=FitConfig(**dict(options.fit, policy=policy, observation=observation, trust=options.trust)),
        cameras=cameras,
        datasets=tuple(options.dataset.root),
        start=start,
        query_rule=None if options.query is None else parse_query(options.query),
        **options.settings,
    )
    check_labels(config)
    check_given(config)
    return config


def _report(options: DaggerOptions, config: RunConfig, results: list[Result], folder: Path) -> None:
    """Write the report of a run."""
    best, kind = best_result(results), ALGORITHMS[config.method]
    first = "cloning" if config.start is None else "the policy given"
    names = [f"{first} (round 0)", *(f"{kind}, round {result.number}" for result in results[1:])]
    sides = [
        Side.of(name, result.validation, labels=result.labels, colour=DAGGER if result.number else CLONING)
        for name, result in zip(names, results, strict=True)
    ]
    success, facts = best.validation.success, tuple[str, ...]()
    if best.number > 0:
        verdict = Comparison(sides[0], sides[best.number]).verdict
        facts = (f"{verdict} The best round was chosen on these episodes, so its success is biased up.",)
    chosen = f"{names[best.number]}, best of {len(results)}"
    write_run_page(
        options,
        folder,
        folder,
        sides,
        kind,
        title=f"{kind} on {config.env.robot} {config.env.task}",
        verdict=f"{chosen}: {success} success on {success.n:,} validation episodes.",
        facts=facts,
    )


def run_rounds(config: RunConfig, folder: Path, engine: Engine, stages: Stages) -> list[Result]:
    """Run all rounds in `folder`, with progress and a printed line per round."""
    write_json(folder / "fingerprint.json", env_fingerprint(config.env, config.cameras))
    results: list[Result] = []
    for result in Run(config, folder, engine, stages.watch()).results():
        stages.close()
        results.append(result)
        success, took = f"validation success {result.validation.success}", f"{sum(result.seconds.values()):.0f} s"
        say(f"round {result.number}: {result.labels:,} labels, {success}, {took}")
        stages.check()
    return results


def write_run_page(options: Any, folder: Path, run: Path, sides: list[Side], kind: str, **parts: Any) -> None:
    """Write to `folder` the report on the policies of `run`: their table, and curves of success over cost.

    kind: the algorithm's name. parts: see `run_report`.
    """
    page = run_report(sides, [Side(kind, (read_member(run),))], fingerprint=sides[-1].results[0].fingerprint, **parts)
    write_page(page, folder / REPORT_FILE, options)
