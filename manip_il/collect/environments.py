"""Environments by robot and task: made, and described for datasets, checkpoints and evaluations.

Robots of our own stand in scenes that are built of a robot and a task; `stock` environments are gymnasium's own.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.collect.expert import Expert
from manip_il.collect.rollout import Environment, Labeller
from manip_il.data.fingerprint import canonical_json, environment_fingerprint
from manip_il.data.schema import SERVOS, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.checkpoint import META_FILE, Checkpoint
from manip_il.mdp import STATE_EXTRAS, State
from manip_il.robots import ROBOTS
from manip_il.robots.action_space import ActionSpace
from manip_il.robots.robot import Robot
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CAMERAS, CameraConfig, EnvConfig, Look
from manip_il.sim.env import ManipEnv, environment_state_names
from manip_il.sim.props import VERSION as DRAWN
from manip_il.sim.scene import SCENES_KEPT, Scene, build_scene
from manip_il.sim.world import World
from manip_il.stock.simulation import StockSimulation, require_no_cameras
from manip_il.stock.table import ACTION_MEANING, PHASES, STATE_NAMES, get_stock
from manip_il.stock.table import ROBOT as STOCK
from manip_il.stock.table import STOCK as STOCK_TASKS
from manip_il.tasks.points import point_names
from manip_il.tasks.table import TASKS, get_task
from manip_il.tasks.task import objects_in, phases

_FOR_PEOPLE = ("README.md", "train_config.json")  # beside a policy, and no part of how it acts
_STOCK = StockSimulation()


def is_known(robot: str, task: str) -> bool:
    """Return whether there is an environment of this robot and task here."""
    return task in STOCK_TASKS if robot == STOCK else robot in ROBOTS and task in TASKS


def make_env(
    config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
) -> Environment:
    """Make an environment. Raises `UsageError` for cameras or conditions that it does not have."""
    if config.robot == STOCK:
        return _STOCK.make(config, cameras, conditions)
    return ManipEnv.of(config, cameras, conditions)


def make_expert(config: EnvConfig) -> Labeller:
    """Make the expert of an environment."""
    return _STOCK.expert(config) if config.robot == STOCK else Expert(_scene(config))


def shares_models(config: EnvConfig) -> bool:
    """Return whether environments of this configuration share one compiled model."""
    return config.robot != STOCK


@cache
def env_spec(config: EnvConfig, cameras: CameraConfig | None = None) -> RobotTaskSpec:
    """Return names, sizes and rate that a dataset or policy for this environment must share."""
    if config.robot == STOCK:
        return _stock_spec(config, cameras)
    scene, task = _scene(config), get_task(config.task, config.object)
    return RobotTaskSpec(
        robot=scene.robot.name,
        task=config.task,
        fps=config.control_hz,
        joint_names=scene.robot.joint_names,
        environment_state_names=environment_state_names(scene),
        sim_state_size=scene.state_size + len(scene.nominal) + STATE_EXTRAS,
        instruction=task.instruction,
        phases=phases(task),
        object=config.object,
        **_in_lerobot(scene.robot),
        cameras=cameras.names if cameras else (),
        image_size=(cameras.height, cameras.width) if cameras else (0, 0),
        keypoints=point_names(scene) if cameras else (),
    )


def _stock_spec(config: EnvConfig, cameras: CameraConfig | None) -> RobotTaskSpec:
    require_no_cameras(cameras)
    task = get_stock(config.task)
    return RobotTaskSpec(
        robot=STOCK,
        task=task.name,
        fps=config.control_hz,
        joint_names=STATE_NAMES,
        environment_state_names=task.observed,
        sim_state_size=_STOCK.state_size(config),
        instruction=task.instruction,
        action_meaning=ACTION_MEANING,
        phases=PHASES,
    )


def env_actions(config: EnvConfig) -> ActionSpace:
    """Return names, bounds and scale of an environment's actions, (n,)."""
    return _STOCK.actions(config) if config.robot == STOCK else _scene(config).actions


def env_fingerprint(config: EnvConfig, cameras: CameraConfig | None = None) -> dict[str, Any]:
    """Return versions, and hashes of the compiled model and of the environment's and the cameras' settings."""
    if cameras is None:
        return dict(_fingerprint(config))
    look = hashlib.sha256(f"{canonical_json(cameras)} {DRAWN}".encode()).hexdigest()
    return {**_fingerprint(config), "cameras_sha256": look}


@cache
def _fingerprint(config: EnvConfig) -> dict[str, str]:
    settings = asdict(config)
    for name in ("object", "reward"):  # as before there were any
        if not settings[name]:
            del settings[name]
    model = _STOCK.model_bytes(config) if config.robot == STOCK else _scene(config).model_bytes()
    return environment_fingerprint(model, settings)


def positions(env: EnvConfig, sim_state: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return the true positions [m] in one row of `sim_state` (m,): `hand`, objects, and `goal`.

    The first object that the episode is about is called `object`; `goal` is where it, or the hand, is to go.
    """
    state = State.from_vector(sim_state)
    found = _STOCK.positions(env, state) if env.robot == STOCK else _positions(env, state)
    return {name: [round(float(value), 4) for value in at] for name, at in found.items()}


def _positions(env: EnvConfig, state: State) -> dict[str, NDArray[np.float64]]:
    world, task = _world(env.robot, env.task, env.object), get_task(env.task, env.object)
    world.restore(state.physics, state.variation)
    found = {"hand": world.ee.position, "goal": task.destination(world)}
    for name in world.scene.objects:
        found["object" if name in objects_in(task, world)[:1] else name] = world.pose(name).position
    return found


def policy_sha256(policy: Path) -> str:
    """Return the SHA-256 of everything in a policy's folder that decides how it acts, but not of where it lies."""
    digest = hashlib.sha256()
    for path in sorted(policy.iterdir()):
        if path.is_file() and path.name not in _FOR_PEOPLE:
            digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def policy_cameras(policy: Path) -> CameraConfig | None:
    """Return cameras, size and light of the pictures that a checkpoint was trained with; None for one without.

    The light is the default where the checkpoint does not say. Raises `MismatchError` for cameras that environments do
    not have or whose pictures differ in size, `ManipError` for a folder or a size that cannot be.
    """
    checkpoint = Checkpoint.open(policy)
    pictures, meta = checkpoint.pictures, checkpoint.origin
    if not pictures:
        return None
    if not set(pictures) <= set(CAMERAS):
        raise MismatchError("cameras", str(policy), ", ".join(pictures), "the environment", ", ".join(CAMERAS))
    if len(set(pictures.values())) > 1:
        sizes = ", ".join(f"{camera} {size}" for camera, size in pictures.items())
        raise MismatchError("size of pictures", str(policy), sizes, "the environment", "one size for all cameras")
    as_recorded = meta is not None and set(meta.cameras) == set(pictures)
    names = meta.cameras if meta is not None and as_recorded else tuple(pictures)
    height, width = next(iter(pictures.values()))
    try:
        return CameraConfig(names, height, width, Look(**(meta.look or {}) if meta else {}))
    except (UsageError, TypeError) as error:
        raise ManipError(f"{policy}: its pictures cannot be rendered ({error}); see its {META_FILE}") from error


def _in_lerobot(robot: Robot) -> dict[str, Any]:
    """What a spec says of a robot whose numbers are its servos'."""
    if robot.lerobot is None:
        return {}
    return {"action_meaning": SERVOS, "robot_type": robot.lerobot.robot_type}


def _scene(config: EnvConfig) -> Scene:
    return build_scene(config.robot, config.task, config.object, config.physics_step)


@lru_cache(SCENES_KEPT)
def _world(robot: str, task: str, shape: str) -> World:
    return World(build_scene(robot, task, shape))
