"""What commands do with their inputs: the environment that is meant, and checks of datasets and policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.algorithms.config import RunConfig
from manip_il.cli.common_options import OF_POLICY
from manip_il.cli.options import Given, Open
from manip_il.cli.progress import warn
from manip_il.collect.drivers import Driver, PolicyDriver, driver_of
from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.schema import SIM_STATE, check_same_spec, features
from manip_il.errors import ManipError, UsageError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.learn.checkpoint import Checkpoint, Origin
from manip_il.learn.sources import check_same_sources
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import complete, env_fingerprint, env_spec, stored_config, world_of

_NOT_COMPARED = ("processor", "config_sha256", "cameras_sha256")


def env_config(env: Given, origin: Origin | None = None) -> EnvConfig:
    """Return the environment: each value as given, else as in the policy's checkpoint, else the default.

    Raises `UnknownName` for an unknown robot or task, `UsageError` for any other invalid value.
    """
    values = {name: value for name, value in env.items() if value is not None}
    if origin is not None:
        if lacking := [one for one in own_files(origin.robot, origin.task) if one[2:].partition(".")[0] not in values]:
            raise UsageError(
                f"the policy is for {origin.robot} {origin.task}, of a file of your own; give {' '.join(lacking)}"
            )
        of_policy: dict[str, Any] = {"robot": origin.robot, "control_hz": origin.fps}
        of_policy |= {} if origin.task == UNKNOWN_TASK else {"task": origin.task}
        values = of_policy | values
        if values.get("task") == origin.task:
            values.setdefault("object", origin.object)
    return complete(EnvConfig(**values))


def own_files(robot: str, task: str, shape: str = "") -> list[str]:
    """Return the options, with FILE for a path, that commands need for what a dataset or a policy only names.

    robot, task, shape: as in a `EnvironmentSpec`.
    """
    return [] if task == UNKNOWN_TASK else world_of(robot).own_files(robot, task, shape)


def env_options(env: EnvConfig) -> list[str]:
    """Return those options of an environment that no dataset or policy stores: paths, and changed limits."""
    try:
        usual = complete(replace(env, tolerance=0.0, horizon=0, success_steps=0))
    except ManipError:  # the user's file was edited or deleted meanwhile
        usual = env
    limits = [name for name in ("tolerance", "horizon", "success_steps") if getattr(env, name) != getattr(usual, name)]
    return path_options(env) + [f"--env.{name}={getattr(env, name):g}" for name in limits]


def path_options(env: EnvConfig) -> list[str]:
    """Return the options that name files of the user's own, which no dataset, policy or result stores."""
    named = {"--robot.type": env.robot, "--task.type": env.task, "--task.object": env.object}
    return [f"{name}={path}" for name, path in named.items() if isinstance(path, Path)]


def start_policy(settings: Open) -> Open:
    """Return the `--policy.*` options of a fit, with `path` resolved to its `pretrained_model` folder."""
    if "path" not in settings:
        return settings
    return settings | {"path": str(find_policy(Path(str(settings["path"])).expanduser()))}


def round_policy(settings: Open) -> tuple[Open, Path | None]:
    """Return the policy options for fits, and the `pretrained_model` folder to start from, if any.

    For an mlp, the options stored in that folder replace the key `path`: they are needed before LeRobot is imported.
    """
    if "path" not in settings:
        return settings, None
    settings = start_policy(settings)
    start = Path(settings["path"])
    if (options := Checkpoint.open(start).mlp_options) is None:
        return settings, start
    if "type" in settings:
        raise UsageError("give one of --policy.path=DIR and --policy.type=...: the checkpoint sets the type")
    return options | {name: value for name, value in settings.items() if name != "path"}, start


def check_given(config: RunConfig) -> None:
    """Raise `MismatchError` unless the datasets and the starting policy of a run fit its environment."""
    recorded = None if config.redraw else config.cameras
    here, run = env_spec(config.env, recorded), f"{config.env.robot} {config.env.task} of this run"
    for root in config.datasets:
        given = Dataset.open(root)
        if SIM_STATE not in given.features:
            advice = "train a policy on it with manip-il train, and start from that: --policy.path=RUN"
            raise ManipError(f"{root} has no {SIM_STATE}, so rollouts cannot be added to it; {advice}")
        check_same_sources((root, Path(run)), (given.spec, here), pictures=config.cameras is not None, language=False)
        check_same_spec(str(root), given.spec, run, here, ["sim_state_size"])
        if odd := sorted(features(given.spec).keys() ^ features(here).keys()):
            raise ManipError(
                f"only one of {root} and this run has {', '.join(odd)}; expected the same --cameras in both"
            )
        warn(*differences(given))
    if config.start is not None:
        check_policy(Checkpoint.open(config.start), config.env, trust=config.fit.trust)


def open_datasets(roots: Sequence[Path], *, pictures: bool, language: bool = False) -> list[Dataset]:
    """Return the datasets; raise `MismatchError` unless they agree with each other and with this program.

    pictures, language: see `check_same_sources`. Warns if a dataset was made with other versions or another model.
    """
    datasets = [*map(Dataset.open, roots)]
    check_same_sources(roots, [one.spec for one in datasets], pictures=pictures, language=language)
    for one in datasets:
        warn(*differences(one))
    return datasets


def differences(dataset: Dataset) -> list[str]:
    """Return a line for each difference in versions or model between a dataset and this machine.

    Raises `MismatchError` if joints or observations differ. A dataset of a user's own arm or task is not compared,
    because it holds only the name of that arm or task.
    """
    spec, name = dataset.spec, str(dataset.root)
    if world_of(spec.robot).own_files(spec.robot, spec.task, spec.object):
        return []
    env = stored_config(spec)
    check_same_spec(name, spec, "this program", env_spec(env))
    # Tolerance and horizon do not affect learning, and a dataset does not hold them; pictures are not compared.
    here = {key: value for key, value in env_fingerprint(env).items() if key not in _NOT_COMPARED}
    theirs = {key: value for key, value in dataset.fingerprint.items() if key not in _NOT_COMPARED}
    return compare_fingerprints(name, theirs, "this machine", here)


def open_driver(
    policy: Path | None, kind: str, env: Given | EnvConfig, *, trust: bool = False, device: str = "cpu"
) -> tuple[EnvConfig, Driver, CameraConfig | None]:
    """Return the environment, the checked driver and the cameras whose pictures the driver takes.

    policy: a checkpoint or a run; if None, `kind` drives: expert, random or sliders. env: an environment, or options
    that the policy's checkpoint completes. device: where a checkpoint runs. Raises what `check_policy` raises.
    """
    if policy is None:
        return env_config(env) if isinstance(env, dict) else env, driver_of(kind), None
    checkpoint = Checkpoint.open(path := find_policy(policy))
    config = env_config(env, checkpoint.origin) if isinstance(env, dict) else env
    return config, PolicyDriver((path,), trust=trust, device=device), check_policy(checkpoint, config, trust=trust)


def why_not_simulated(checkpoint: Checkpoint) -> str:
    """Return why no environment of this program fits a policy of another program's data; "" if one does."""
    try:
        env = env_config(OF_POLICY, checkpoint.origin)
        checkpoint.check_fits(env_spec(env, checkpoint.cameras))
    except ManipError as error:
        return checks.one_line(error)
    return ""


def check_policy(checkpoint: Checkpoint, env: EnvConfig, *, trust: bool = False) -> CameraConfig | None:
    """Return the cameras whose pictures the policy takes, if any; warn if its task or model differs from `env`.

    Raises `MismatchError` unless the policy can drive `env`, `ManipError` if loading it needs `trust`.
    """
    path = checkpoint.path
    origin = checkpoint.origin
    cameras = checkpoint.cameras
    spec = env_spec(env, cameras)
    checkpoint.check_fits(spec)
    checkpoint.require_trust(trust)
    if origin is None:
        warn(f"{path} was written by another tool and does not say which robot and task it is for")
    elif origin.task != spec.task:  # the model and its hash differ, too
        warn(f"task differs: {path} has {origin.task}, the environment has {spec.task}")
    else:
        theirs = {name: value for name, value in origin.fingerprint.items() if cameras or name != "cameras_sha256"}
        warn(*compare_fingerprints(str(path), theirs, "the environment", env_fingerprint(env, cameras)))
    return cameras
