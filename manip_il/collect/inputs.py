"""What work does with its inputs: the environment that is meant, and whether datasets and
policies fit it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.schema import check_same_spec
from manip_il.errors import UnknownName, warn
from manip_il.learn.checkpoint import Checkpoint, Origin
from manip_il.sim.shape import MESH
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import (
    complete,
    env_fingerprint,
    env_spec,
    stored_config,
)

_FLAGS = {"robot": "--robot.type", "task": "--task.type", "object": "--task.object"}
_NOT_COMPARED = ("processor", "config_sha256", "cameras_sha256")


def env_config(given: Mapping[str, Any], origin: Origin | None = None) -> EnvConfig:
    """Return the environment: each value as given, else as in the policy's checkpoint, else the
    default.

    Raises `UnknownName` for an unknown robot or task, `UsageError` for any other invalid value.
    """
    values = {name: value for name, value in given.items() if value is not None}
    if origin is not None:
        of_policy: dict[str, Any] = {"robot": origin.robot, "control_hz": origin.fps}
        of_policy |= {} if origin.task == UNKNOWN_TASK else {"task": origin.task}
        values = of_policy | values
        if values.get("task") == origin.task:
            values.setdefault("object", origin.object)
    return complete(EnvConfig(**values))


def path_options(env: Mapping[str, Any]) -> list[str]:
    """Return the options of an environment that name files of the user's own, which nothing that
    is written stores.
    """
    return [f"{flag}={env[key]}" for key, flag in _FLAGS.items() if isinstance(env.get(key), Path)]


def open_dataset(root: Any) -> Dataset:
    """Return a dataset.

    Warn if it was made with other versions or another model, see `differences`.
    """
    dataset = Dataset.open(root)
    warn(*differences(dataset))
    return dataset


def named_env(dataset: Dataset) -> EnvConfig | None:
    """Return the environment that a dataset names.

    None if it was recorded by others, or with a file of the user's own, of which only the name is
    stored.
    """
    spec = dataset.spec
    try:
        if dataset.own is None or spec.object.startswith(f"{MESH}:"):
            return None
        return stored_config(spec)
    except UnknownName:
        return None


def differences(dataset: Dataset) -> list[str]:
    """Return a line for each difference in versions or model between a dataset and this machine.

    Raises `MismatchError` if joints or observations differ. A dataset of a user's own arm, task
    or mesh is not compared, because it holds only the name of it.
    """
    spec, name = dataset.spec, str(dataset.root)
    if (env := named_env(dataset)) is None:
        return []
    check_same_spec(name, spec, "this program", env_spec(env))
    # Tolerance and horizon do not affect learning, and a dataset does not hold them; pictures are
    # not compared.
    here = {key: value for key, value in env_fingerprint(env).items() if key not in _NOT_COMPARED}
    theirs = {key: value for key, value in dataset.fingerprint.items() if key not in _NOT_COMPARED}
    return compare_fingerprints(name, theirs, "this machine", here)


def check_policy(checkpoint: Checkpoint, env: EnvConfig, *, trust: bool = False) -> None:
    """Check that a policy can drive an environment, and warn if its task or model differs.

    Args:
        checkpoint: The policy.
        env: The environment that it is to drive.
        trust: Whether the policy may load models or code by name.

    Raises:
        MismatchError: if the policy cannot drive `env`.
        ManipError: if loading the policy needs `trust`.
        Unable: if the policy needs pictures, and `env` cannot be drawn.
    """
    path = str(checkpoint.path)
    origin, cameras = checkpoint.origin, checkpoint.cameras
    spec = env_spec(env, cameras)
    checkpoint.check_fits(spec)
    checkpoint.require_trust(trust)
    if origin is None:
        lines = [
            f"{path} was written by another tool and does not say which robot and task it is for"
        ]
    elif origin.task != spec.task:  # the model and its hash differ, too
        lines = [f"task differs: {path} has {origin.task}, the environment has {spec.task}"]
    else:
        theirs = {
            name: value
            for name, value in origin.fingerprint.items()
            if cameras or name != "cameras_sha256"
        }
        lines = compare_fingerprints(path, theirs, "the environment", env_fingerprint(env, cameras))
    warn(*lines)
