"""Scenes and environments by the names of robot and task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from manip_il.option import NameOrPath
from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig, Look
from manip_il.sim.env import ManipEnv
from manip_il.sim.scene import Scene, build_scene
from manip_il.sim.task import Task
from manip_il.tasks.table import get_task
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import make_config


def scene_of(robot: NameOrPath, task: NameOrPath, shape: NameOrPath = "") -> Scene:
    """Return the compiled scene of a robot, a task and an object, as in `EnvConfig`.

    Raises `UnknownName`, `UsageError`.
    """
    return build_scene(get_robot(robot), get_task(task, shape))


def config_scene(config: EnvConfig) -> Scene:
    """Return the compiled scene of an environment."""
    return build_scene(*parts_of(config), config.physics_step)


def env_of(config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()) -> ManipEnv:
    """Return the environment that these settings describe."""
    return ManipEnv(*parts_of(config), config, cameras=cameras, conditions=conditions)


def make_env(
    robot: NameOrPath = EnvConfig.robot,
    task: NameOrPath = EnvConfig.task,
    *,
    cameras: Sequence[str] = (),
    image_size: tuple[int, int] = (128, 128),
    look: Look | None = None,
    render_mode: str | None = None,
    conditions: Sequence[Condition] = (),
    **settings: Any,
) -> ManipEnv:
    """Return the environment of a robot, by its name or its YAML's path, and a task, by its name or its file's path.

    cameras: names; image_size: height and width of their pictures [pixels]. settings: fields of `EnvConfig`; the rest
    is as in `ManipEnv`. Raises what `make_config`, `CameraConfig` and `ManipEnv` raise.
    """
    config = make_config(robot, task, **settings)
    seen = CameraConfig(tuple(cameras), *image_size, look or Look()) if cameras else None
    return ManipEnv(*parts_of(config), config, cameras=seen, look=look, render_mode=render_mode, conditions=conditions)


def parts_of(config: EnvConfig) -> tuple[Robot, Task]:
    """Return the robot and the task of an environment."""
    return get_robot(config.robot), get_task(config.task, config.object)
