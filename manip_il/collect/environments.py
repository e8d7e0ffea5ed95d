"""Make environments by robot and task, and describe them for datasets, checkpoints and evaluations.

Our own scenes are built from a robot and a task; `stock` environments are gymnasium's.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

from manip_il.caching import cached_per_thread
from manip_il.collect.expert import Expert
from manip_il.collect.rollout import Environment, Labeller
from manip_il.data.fingerprint import canonical_json, environment_fingerprint
from manip_il.data.schema import OPENINGS, SERVOS, RobotTaskSpec
from manip_il.mdp import STATE_EXTRAS
from manip_il.robots import ROBOTS
from manip_il.robots.action_space import ActionSpace
from manip_il.robots.files import ModelFiles
from manip_il.robots.spec import model_bytes
from manip_il.robots.table import get_robot, is_robot
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import environment_state_names
from manip_il.sim.points import point_names
from manip_il.sim.props import VERSION as DRAWN
from manip_il.sim.scene import SCENES_KEPT
from manip_il.sim.shape import MESH, ObjectShape, stored
from manip_il.sim.task import phases
from manip_il.tasks.config import EnvConfig
from manip_il.tasks.envs import config_scene, env_of
from manip_il.tasks.stock.envs import check_cameras, described_stock, make_stock, make_stock_expert
from manip_il.tasks.stock.table import ROBOTS as STOCK
from manip_il.tasks.table import TASKS, get_task, is_task, source_hash

_TURNED = ("carry", "insert", "insert_tight", "press")  # tasks whose furniture older versions rendered without its yaw


def is_known(robot: str, task: str, shape: str = "") -> bool:
    """Return whether this robot, task and object are built in."""
    if robot in STOCK:
        return task in STOCK[robot].tasks
    return is_robot(robot) and is_task(task) and not shape.startswith(MESH)


def make_env(
    config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
) -> Environment:
    """Make an environment. Raises `UsageError` for cameras or conditions that it does not support."""
    if config.robot in STOCK:
        return make_stock(config.robot, config.task, cameras, conditions)
    return env_of(config, cameras, conditions)


@cached_per_thread(SCENES_KEPT)
def make_expert(config: EnvConfig) -> Labeller:
    """Return the expert of an environment, cached for this thread."""
    return make_stock_expert(config.robot, config.task) if config.robot in STOCK else Expert(config_scene(config))


@cache
def env_spec(config: EnvConfig, cameras: CameraConfig | None = None) -> RobotTaskSpec:
    """Return the names, sizes and rate that a dataset or policy for this environment must share."""
    check_cameras(config.robot, cameras)
    pictures: dict[str, Any] = {"cameras": cameras.names, "image_size": cameras.size} if cameras else {}
    if config.robot in STOCK:
        robot = STOCK[config.robot]
        stock = robot.tasks[str(config.task)]
        return RobotTaskSpec(
            robot=str(config.robot),
            task=stock.name,
            fps=config.control_hz,
            joint_names=robot.joint_names,
            environment_state_names=stock.observed,
            sim_state_size=len(described_stock(config.robot, config.task).get_state().to_vector()),
            instruction=stock.instruction,
            action_meaning=robot.action_meaning,
            phases=stock.phases,
            **pictures,
        )
    scene, task = config_scene(config), get_task(config.task, config.object)
    servos = scene.robot.lerobot
    return RobotTaskSpec(
        robot=scene.robot.name,
        task=task.name,
        fps=config.control_hz,
        joint_names=scene.robot.joint_names,
        environment_state_names=environment_state_names(scene),
        sim_state_size=scene.state_size + len(scene.nominal) + STATE_EXTRAS,
        instruction=task.instruction,
        phases=phases(task),
        object=stored(config.object),
        action_meaning=SERVOS if servos else OPENINGS,
        robot_type=servos.robot_type if servos else "",
        keypoints=point_names(scene) if cameras else (),
        **pictures,
    )


def env_actions(config: EnvConfig) -> ActionSpace:
    """Return names, bounds and scale of an environment's actions, (n,)."""
    return (described_stock(config.robot, config.task) if config.robot in STOCK else config_scene(config)).actions


def env_fingerprint(config: EnvConfig, cameras: CameraConfig | None = None) -> dict[str, Any]:
    """Return package versions, processor, and hashes of the compiled model and of environment and camera settings."""
    if cameras is None:
        return dict(_fingerprint(config))
    drawn = DRAWN + (str(config.task).partition(":")[0] in _TURNED)
    look = hashlib.sha256(f"{canonical_json(cameras)} {drawn}".encode()).hexdigest()
    return {**_fingerprint(config), "cameras_sha256": look}


@cache
def _fingerprint(config: EnvConfig) -> dict[str, str]:
    settings, own = asdict(config), dict[str, str]()
    if config.robot not in STOCK:
        task = get_task(config.task, config.object)
        robot = get_robot(config.robot)
        settings["robot"], (settings["task"], _, argument) = robot.name, task.name.partition(":")
        settings |= {"reward": argument} if argument else {}  # as in older fingerprints, where only carry has it
        own = {} if settings["task"] in TASKS else {"task_sha256": source_hash(task)}
        if robot.name not in ROBOTS:  # a user's own robot: hash its values, not its files' paths
            said = replace(robot, files=ModelFiles(Path()), gripper=replace(robot.gripper, files=None))
            own |= {"robot_sha256": hashlib.sha256(repr(said).encode()).hexdigest()}
        mesh = ObjectShape.parse(config.object).mesh if config.object else None
        settings["object"], own = stored(config.object), own | ({"object_sha256": mesh.sha256} if mesh else {})
    if not config.object:  # as in fingerprints of versions that had no `object`
        del settings["object"]
    made = described_stock(config.robot, config.task) if config.robot in STOCK else config_scene(config)
    return environment_fingerprint(model_bytes(made.model), settings) | own
