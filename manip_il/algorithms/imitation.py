"""Run DAgger, or another algorithm of imitation, in a folder."""

import json
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.algorithms.config import BetaSchedule, RunConfig, check_labels
from manip_il.algorithms.results import Result
from manip_il.algorithms.run import Run
from manip_il.collect.inputs import check_policy, open_dataset
from manip_il.collect.query import parse_query
from manip_il.collect.workers import Engine, engine_of
from manip_il.data.atomic import CONFIG_FILE, output_of, require_ours, write_json
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.schema import SIM_STATE, check_same_spec, features
from manip_il.errors import ManipError, MismatchError, UsageError, warn
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.option import make_options
from manip_il.progress import Progress
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_fingerprint, env_of_name, env_spec


def dagger(
    output_dir: Path | str,
    config: RunConfig | EnvConfig | str,
    *,
    workers: int | Engine | None = 1,
    progress: Progress | None = None,
    **options: Any,
) -> list[Result]:
    """Run DAgger, or another `method`, in a folder.

    A folder with finished rounds is continued with the same options, except that `rounds` may be
    larger.

    Args:
        output_dir: The run's folder.
        config: The run's options, or its environment, such as `"panda/lift"`.
        workers: Number of processes, None for one per core; or the engine to use.
        progress: Follows the run.
        options: With an environment, the run's other options, see `run_config`.

    Returns:
        The results of all rounds, starting with 0 (cloning).

    Raises:
        UsageError: for options that contradict each other, or a folder with other files.
        MismatchError: if the options differ from the folder's, or a dataset or a policy does not
            fit the environment.
    """
    folder = Path(output_dir).expanduser()
    progress = progress or Progress()
    if isinstance(config, RunConfig) and options:
        raise UsageError(f"{', '.join(options)}: expected in the RunConfig that was given")
    if not isinstance(config, RunConfig):
        config = run_config(config, **options)
    check_labels(config)
    check_inputs(config)
    require_ours(folder, output_of("Dagger"))
    progress.started()
    # from the command line, which compares its options itself
    if not (folder / CONFIG_FILE).is_file():
        _check_same(folder / "settings.json", config)
    _warn_of_changes(folder / "fingerprint.json", env_fingerprint(config.env, config.cameras))
    results = list[Result]()
    with engine_of(workers) as engine:
        engine.warm_up(learned=True)
        for result in Run(config, folder, engine, progress).results():
            results.append(result)
            progress.finished(result)
    return results


def run_config(env: EnvConfig | str, *, query: str | None = None, **options: Any) -> RunConfig:
    """Return the options of a run.

    Args:
        env: The environment, or its name, `panda` or `panda/lift`.
        query: As on the command line, such as `"probability:0.1"`.
        options: Other fields of `RunConfig`; `beta` may be a text such as `"linear:5"`.

    Raises:
        UnknownName: for an option that there is not.
        UsageError: for a value that is not allowed.
    """
    if isinstance(beta := options.get("beta"), str):
        options["beta"] = BetaSchedule.parse(beta)
    if query is not None:
        options["query_rule"] = parse_query(query)
    return make_options(RunConfig, env=env_of_name(env), **options)


def check_inputs(config: RunConfig) -> None:
    """Check that the datasets and the starting policy of a run fit its environment.

    Raises:
        MismatchError: A dataset or the policy does not fit.
        ManipError: A dataset has no states of the simulator or other cameras than the run, or the
            policy cannot be read.
    """
    recorded = None if config.redraw else config.cameras
    here, run = env_spec(config.env, recorded), f"{config.env.robot} {config.env.task} of this run"
    for root in config.datasets:
        given = open_dataset(root)
        if SIM_STATE not in given.features:
            raise ManipError(
                f"{root} has no {SIM_STATE}, so rollouts cannot be added to it; train a policy on"
                " it with manip-il train, and start from that: --policy.path=RUN"
            )
        pictured = ("cameras", "image_size") if config.cameras else ()
        also = ("task", "sim_state_size", *pictured)
        check_same_spec(str(root), given.spec, run, here, also)
        if odd := sorted(features(given.spec).keys() ^ features(here).keys()):
            raise ManipError(
                f"only one of {root} and this run has {', '.join(odd)}; expected the same --cameras"
                " in both"
            )
    if config.start is not None:
        check_policy(Checkpoint.open(config.start), config.env, trust=config.fit.trust)


def _warn_of_changes(path: Path, now: dict[str, str]) -> None:
    """Warn if a run began in an environment other than now; then write what it is now."""
    before = checks.read_json(path, "a run's fingerprint") if path.is_file() else now
    warn(*compare_fingerprints(str(path.parent), before, "this program", now))
    write_json(path, now)


def _check_same(path: Path, config: RunConfig) -> None:
    """Raise `MismatchError` if a run began with options other than `config`; then write it.

    `rounds` may differ, and those options of the fit that change no result.
    """
    now = json.loads(json.dumps(asdict(replace(config, rounds=0)), default=str))
    now["fit"] = {
        one.name: now["fit"][one.name] for one in fields(FitConfig) if not one.metadata.get("free")
    }
    has_begun = any(path.parent.glob("round_*"))
    before = checks.read_json(path, "a run's options") if has_begun and path.is_file() else now
    for key in now:
        if before.get(key) != now[key]:
            raise MismatchError(key, str(path.parent), before[key], "this call", now[key])
    write_json(path, now)
