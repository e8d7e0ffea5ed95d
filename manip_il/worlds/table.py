"""Worlds by the robot's name, and what is made from an environment's settings.

Importing this module loads no simulator: a world is imported when it is first used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.caching import cached_per_thread
from manip_il.errors import UsageError
from manip_il.option import NameOrPath, check_bounds, make_options, typed
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import WORLD_GROUP, WORLDS, EnvConfig

if TYPE_CHECKING:
    from manip_il.sim.conditions import Condition
    from manip_il.worlds.contract import Environment, EnvironmentSpec, Expert, WorldKind

_KEPT = 4  # environments and experts kept for each thread: the finest scenes take 64 MB


_OURS = "manip_il.worlds.ladder.world"  # of every other robot


@cache
def world_of(robot: NameOrPath, task: NameOrPath = "") -> WorldKind:
    """Return the world of a robot, of a `Path` of a world of one's own, or of an entry point.

    Args:
        robot: Its name or path.
        task: Its task, or several, which then are one world.
    """
    kind = _kind_of(robot)
    if len(names := kind.tasks_in(task)) > 1:
        return import_module("manip_il.worlds.several").SeveralTasks(kind, names)
    return kind


def task_names(config: EnvConfig) -> tuple[NameOrPath, ...]:
    """Return the tasks that the episodes of an environment have, in turn by seed."""
    return world_of(config.robot).tasks_in(config.task)


@cache
def _kind_of(robot: NameOrPath) -> WorldKind:
    is_file = isinstance(robot, Path) and robot.suffix == ".py"
    if is_file or entry_points(group=WORLD_GROUP, name=str(robot)):
        return import_module("manip_il.worlds.gym.environment").own_kind(robot)
    return import_module(WORLDS[robot].module if robot in WORLDS else _OURS).WORLD


def make_config(
    robot: NameOrPath = EnvConfig.robot,
    task: NameOrPath = EnvConfig.task,
    control_hz: int = 0,
    **settings: Any,
) -> EnvConfig:
    """Return the settings of an environment; what is not given comes from its robot and task.

    This function is for what a person wrote: names that end in `.py` or `.yaml` and objects
    `mesh:FILE` are paths. What is stored goes to `complete`, where a `str` is a name.

    Args:
        robot: Its name, or the path of its YAML.
        task: Its name, or the path of its Python file.
        control_hz: Control steps per second; 0 for the robot's own.
        settings: Other fields of `EnvConfig`.

    Raises:
        UnknownName: for a robot or a task.
        UsageError: for a wrong value.
    """
    settings |= {
        "robot": typed(robot),
        "task": typed(task),
        "object": typed(settings.get("object", "")),
    }
    return complete(make_options(EnvConfig, control_hz=control_hz, **settings))


def env_of_name(env: EnvConfig | str) -> EnvConfig:
    """Return the environment of a name, `panda` or `panda/lift`; settings as they are."""
    if not isinstance(env, str):
        return env
    robot, _, task = env.partition("/")
    return make_config(robot, task or EnvConfig.task)


def stored_config(
    spec: Any,
    robot: NameOrPath | None = None,
    task: NameOrPath | None = None,
    shape: NameOrPath | None = None,
) -> EnvConfig:
    """Return the settings of the environment that a dataset or a policy names.

    What it names is never a path.

    Args:
        spec: A `EnvironmentSpec` or an `Origin`.
        robot: What the user gave, which replaces the name in `spec`; the same for the task.
        task: See `robot`.
        shape: See `robot`; the object.

    Raises:
        UnknownName: if a robot or a task that is not built in was not given.
        UsageError: if a mesh was not given, and whatever else `make_config` raises.
    """
    named = {
        "robot": robot or spec.robot,
        "task": task or spec.task,
        "object": shape or spec.object,
    }
    return complete(replace(EnvConfig(spec.fps), **named))


def complete(config: EnvConfig) -> EnvConfig:
    """Return settings with 0 and empty values filled in from robot and task.

    Raises what `make_config` raises.
    """
    check_bounds(config)
    config = world_of(config.robot, config.task).complete(config)
    if config.horizon < config.success_steps:
        raise UsageError(
            f"horizon is {config.horizon}, success_steps {config.success_steps}; expected horizon"
            " >= success_steps"
        )
    return config


def make_env(
    config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
) -> Environment:
    """Make an environment.

    Args:
        config: Its settings, complete.
        cameras: What it observes besides numbers.
        conditions: How episodes differ from the nominal world, in turn by seed.

    Raises:
        Unable: if the environment cannot be drawn or varied.
        UnknownName: for a camera that it does not have.
    """
    spec = env_spec(config, cameras)
    if changed := [one.name for one in conditions if one.ranges]:
        spec.require("varied", f"leave out {', '.join(changed)}")
    return world_of(config.robot, config.task).environment(config, cameras, conditions)


@cached_per_thread(_KEPT)
def described_env(config: EnvConfig) -> Environment:
    """Return an environment, cached for this thread, to read from; no episode runs in it."""
    return world_of(config.robot, config.task).environment(config, None, ())


@cached_per_thread(_KEPT)
def make_expert(config: EnvConfig) -> Expert:
    """Return the expert of an environment, cached for this thread."""
    return world_of(config.robot, config.task).expert(config)


@cache
def env_spec(config: EnvConfig, cameras: CameraConfig | None = None) -> EnvironmentSpec:
    """Return what a dataset or a policy for this environment must share.

    Raises what `make_env` raises for cameras.
    """
    spec = described_env(config).spec
    if cameras is None:
        return spec
    spec.require_cameras(cameras)
    return replace(spec, cameras=cameras.names, image_size=cameras.size, keypoints=spec.points)


def env_fingerprint(config: EnvConfig, cameras: CameraConfig | None = None) -> dict[str, str]:
    """Return package versions, processor, and hashes of the compiled model and of environment
    and camera settings.
    """
    found = _fingerprint(config)
    if cameras is None:
        return found
    return found | {"cameras_sha256": env_spec(config).look_sha256(cameras)}


@cache
def _fingerprint(config: EnvConfig) -> dict[str, str]:
    return world_of(config.robot, config.task).fingerprint(config)
