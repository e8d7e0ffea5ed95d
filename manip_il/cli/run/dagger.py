"""Run `manip-il dagger`: roll out, label, aggregate, refit, and repeat."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from manip_il.algorithms.config import ALGORITHMS, RunConfig
from manip_il.algorithms.imitation import dagger
from manip_il.algorithms.results import validation_report
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.options import Open
from manip_il.cli.outputs import REPORT_FILE, about
from manip_il.cli.progress import Stages, say, say_next
from manip_il.collect.inputs import env_config
from manip_il.collect.query import parse_query
from manip_il.data.json_lines import read_lines
from manip_il.errors import UsageError
from manip_il.evaluation.rounds import METRICS_FILE
from manip_il.evaluation.suites import varied
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.policy_folder import with_folder


def run_dagger(options: DaggerOptions) -> None:
    """Run all rounds, or continue them."""
    config, folder = dagger_config(options), options.output_dir
    kept = f"every finished episode and round, in {folder}"
    with options.lock() as prepare, Stages(kept, prepare) as stages, options.open_engine() as engine:
        results = dagger(folder, config, workers=engine, progress=stages)
        kind = ALGORITHMS[config.method]
        page = validation_report(
            f"{kind} on {config.env.robot} {config.env.task}",
            "cloning" if config.start is None else "the policy given",
            {result.number: result.validation for result in results},
            read_lines(folder / METRICS_FILE),
        )
        replace(page, **about(options)).write(folder / REPORT_FILE)
    if (folder / "dataset").is_dir():
        say(f"labels of all rounds as one dataset: {folder / 'dataset'}")
    say_best(folder)


def say_best(folder: Path) -> None:
    """Print where a run's report and best policy are, and how to evaluate that."""
    best = folder / "best" / "pretrained_model"
    say(f"report: {folder / REPORT_FILE}", f"best policy: {best}")
    say_next("eval", f"--policy.path={best}", f"--output_dir={folder}/test")


def dagger_config(options: DaggerOptions) -> RunConfig:
    """Return the configuration of the run; raises if options contradict each other."""
    policy, start = round_policy(with_folder(options.fit.get("policy", {})))
    observation, env = options.fit.get("observation"), env_config(options.env)
    sees = policy.get("type") == "cnn" and observation != "state"
    cameras = options.camera_config(env) if options.cameras or sees else None
    if start is not None:
        observation, cameras = observation or start.observation, cameras or start.cameras
    return RunConfig(
        env=env,
        method=options.method,
        conditions=varied(options.vary, env, sees=cameras is not None),
        fit=FitConfig(**dict(options.fit, policy=policy, observation=observation, trust=options.trust)),
        cameras=cameras,
        datasets=tuple(options.dataset.root),
        start=start and start.path,
        query_rule=None if options.query is None else parse_query(options.query),
        **options.settings,
    )


def round_policy(settings: Open) -> tuple[Open, Checkpoint | None]:
    """Return the policy options for fits, and the checkpoint to start from, if any.

    For an mlp, the options stored in the checkpoint replace the key `path`: they are needed before LeRobot is imported.
    """
    if "path" not in settings:
        return settings, None
    start = Checkpoint.open(Path(settings["path"]))
    if (options := start.mlp_options) is None:
        return settings, start
    if "type" in settings:
        raise UsageError("give one of --policy.path=DIR and --policy.type=...: the checkpoint sets the type")
    return options | {name: value for name, value in settings.items() if name != "path"}, start
