"""The commands as functions, for notebooks and scripts: record, train, dagger, evaluate.

Options are fields of the same classes that the commands use, with the same names and defaults. Episodes run in
`workers` processes: 1 is this process alone, None is one per core. An environment may be given by its name, `panda` or
`panda/lift`, and a dataset or a policy by its path.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, Literal

from manip_il import checks
from manip_il.algorithms.config import BetaSchedule, RunConfig, check_labels
from manip_il.algorithms.results import Result
from manip_il.algorithms.run import Run
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.query import parse_query
from manip_il.collect.record import MAX_TRIES, collect, collect_successes, provenance
from manip_il.collect.workers import Engine
from manip_il.data.atomic import write_json
from manip_il.data.build import Recording
from manip_il.data.dataset import Dataset
from manip_il.data.ownership import output_of, require_ours, require_replaceable
from manip_il.errors import MismatchError, UsageError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.runner import HOLD, episode_hold
from manip_il.evaluation.runner import evaluate as run_episodes
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.option import make_options, takes
from manip_il.seeding import BLOCK, stream_base, stream_seeds
from manip_il.sim.conditions import NOMINAL
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import make_config, stored_config, world_of

Policy = Checkpoint | Path | str
Data = Dataset | Path | str
_MOST_EPISODES = BLOCK // MAX_TRIES


@takes(RolloutJob, "driver")
def record(
    root: Path | str,
    env: EnvConfig | str,
    episodes: int = 50,
    *,
    policy: Policy | None = None,
    beta: float = 0.0,
    query: str = "every",
    seed: int = 0,
    workers: int | None = 1,
    **options: Any,
) -> Dataset:
    """Record a dataset: the expert's successful demonstrations or, given a policy, all rollouts of the policy.

    beta: share of the steps that the expert drives instead of the policy. query: when the expert is queried, as for
    `manip-il dagger --query`. options: other fields of `RolloutJob`, such as `label` and `cameras`; `round` is by
    default 1 with a policy, else 0.
    Each frame holds the executed action and the expert's label. Raises `UsageError` if the folder holds files.
    """
    root = _path(root)
    driver = RolloutJob.driver if policy is None else PolicyDriver((_folder(policy),), beta)
    chosen: dict[str, Any] = {"hold": HOLD, "round": 0 if policy is None else 1, "query": parse_query(query)} | options
    job = make_options(RolloutJob, env=_env(env), driver=driver, **chosen)
    episodes = checks.whole("episodes", episodes, 1, _MOST_EPISODES)
    journals = root.with_name(f"{root.name}.journals")
    for folder in (root, journals):
        require_replaceable(folder)
    recording = Recording(provenance=provenance(job), only_labelled=not job.labels_all)
    with Engine(workers) as engine:
        if policy is None:
            seeds = stream_seeds("demonstrations", MAX_TRIES * episodes, seed)
            made = collect_successes(engine, job, seeds, episodes, journals)
            recording = replace(recording, only_successes=True, episodes=episodes)
        else:
            made = collect(engine, job, stream_seeds(f"round/{job.round}", episodes, seed), journals)
        recording.write(journals)
        recording.make(made, root)
    return Dataset.open(root)


@takes(FitConfig)
def train(
    datasets: Data | Sequence[Data],
    output_dir: Path | str,
    *,
    seed: int = 0,
    on_log: Callable[[dict[str, Any]], None] | None = None,
    **options: Any,
) -> Checkpoint:
    """Fit a policy to the labels of one or more datasets; return its checkpoint.

    options: fields of `FitConfig`, such as `policy={"type": "mlp", "width": 128}`, `steps` and `batch_size`. on_log:
    called after every step with its metrics, or {} if there are none. Raises `UsageError` if `output_dir` has a
    checkpoint or holds other files, `ManipError` for data that do not fit the policy.
    """
    from manip_il.learn.train import Trainer  # LeRobot's trainer takes seconds to import

    output_dir = _path(output_dir)
    require_ours(output_dir, output_of("Train"))
    given = (datasets,) if isinstance(datasets, Data) else datasets
    opened = tuple(one if isinstance(one, Dataset) else Dataset.open(_path(one)) for one in given)
    config = make_options(FitConfig, seed=stream_base("training", seed), **options)
    return Checkpoint.open(Trainer(opened, config, output_dir).fit(on_log))


@takes(RunConfig, "query_rule")
def dagger(
    output_dir: Path | str,
    env: EnvConfig | str,
    *,
    beta: str | None = None,
    query: str | None = None,
    fit: FitConfig | None = None,
    workers: int | None = 1,
    **options: Any,
) -> list[Result]:
    """Run DAgger, or another `method`, in a folder; return the results of all rounds, starting with 0 (cloning).

    beta, query: as on the command line, such as `"linear:5"` and `"probability:0.1"`. options: other fields of
    `RunConfig`. A folder with finished rounds is continued with the same options, except that `rounds` may be larger.
    Raises `UsageError` for options that contradict each other, or a folder with other files, `MismatchError` if they
    differ from the folder's.
    """
    output_dir = _path(output_dir)
    options |= {} if beta is None else {"beta": BetaSchedule.parse(beta)}
    options |= {} if query is None else {"query_rule": parse_query(query)}
    if "datasets" in options:
        options["datasets"] = tuple(map(_root, options["datasets"]))
    if options.get("start") is not None:
        options["start"] = _folder(options["start"])
    config = make_options(RunConfig, env=_env(env), fit=fit or FitConfig(), **options)
    check_labels(config)
    _check_same(output_dir / "settings.json", config)
    with Engine(workers) as engine:
        return list(Run(config, output_dir, engine).results())


@takes(RolloutJob, "driver")
def evaluate(
    policy: Policy | None = None,
    env: EnvConfig | str | None = None,
    episodes: int = 100,
    *,
    stream: Literal["test", "validation"] = "test",
    seed: int = 0,
    workers: int | None = 1,
    **options: Any,
) -> EvalResult:
    """Evaluate a policy, by default the expert, on unseen seeds; return the outcome of every episode.

    env: by default the policy's training environment. options: fields of `RolloutJob`, such as `conditions`.
    Raises `UsageError` if neither `env` nor the policy names an environment, `MismatchError` if the policy does not fit
    `env`.
    """
    path = None if policy is None else _folder(policy)
    if env is None:
        origin = None if path is None else Checkpoint.open(path).origin
        if origin is None:
            raise UsageError("env is missing, and the policy does not name one")
        if world_of(origin.robot).own_files(origin.robot, origin.task, origin.object):
            raise UsageError(
                f"the policy is for the robot {origin.robot} and the task {origin.task} of your own, of which it holds "
                "only the names; give env=make_config(...) with your files"
            )
        env = stored_config(origin)
    env = _env(env)
    driver = RolloutJob.driver if path is None else PolicyDriver((path,))
    chosen: dict[str, Any] = {"hold": episode_hold(env), "label": "last"} | options
    job = make_options(RolloutJob, env=env, driver=driver, **chosen)
    episodes = checks.whole("episodes", episodes, 1, BLOCK)
    suite = "_".join(one.name for one in job.conditions) or NOMINAL.name
    with Engine(workers) as engine:
        return run_episodes(engine, job, stream_seeds(stream, episodes, seed), str(path or "expert"), suite=suite)


def _check_same(path: Path, config: RunConfig) -> None:
    """Raise `MismatchError` if a run began with options other than `config`; then write it.

    `rounds` may differ, and those options of the fit that change no result.
    """
    now = json.loads(json.dumps(asdict(replace(config, rounds=0)), default=str))
    now["fit"] = {one.name: now["fit"][one.name] for one in fields(FitConfig) if not one.metadata.get("free")}
    require_ours(path.parent, output_of("Dagger"))
    has_begun = any(path.parent.glob("round_*"))
    before = checks.read_json(path, "a run's options") if has_begun and path.is_file() else now
    for key in now:
        if before.get(key) != now[key]:
            raise MismatchError(key, str(path.parent), before[key], "this call", now[key])
    write_json(path, now)


def _env(env: EnvConfig | str) -> EnvConfig:
    if not isinstance(env, str):
        return env
    robot, _, task = env.partition("/")
    return make_config(robot, task or EnvConfig.task)


def _root(dataset: Data) -> Path:
    return dataset.root if isinstance(dataset, Dataset) else _path(dataset)


def _folder(policy: Policy) -> Path:
    return policy.path if isinstance(policy, Checkpoint) else find_policy(_path(policy))


def _path(path: Path | str) -> Path:
    if not isinstance(path, Path | str):
        raise UsageError(f"path is {checks.shorten(path)}; expected a path")
    return Path(path).expanduser()
