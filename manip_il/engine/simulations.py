"""Simulations by robot: where environment, expert and description of a configuration come from.

Robots of our own stand in scenes that are built of a robot and a task; `SIMULATIONS` names those that have another one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from manip_il.data.schema import SERVOS, RobotTaskSpec
from manip_il.expert import Expert
from manip_il.mdp import STATE_EXTRAS, State
from manip_il.robots import ROBOTS
from manip_il.robots.action_space import ActionSpace
from manip_il.robots.robot import Robot
from manip_il.rollout import Environment, Labeller
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig, EnvConfig
from manip_il.sim.env import ManipEnv, environment_state_names
from manip_il.sim.scene import SCENES_KEPT, Scene, build_scene
from manip_il.sim.world import World
from manip_il.stock.simulation import StockSimulation
from manip_il.stock.table import ROBOT as STOCK
from manip_il.stock.table import STOCK as STOCK_TASKS
from manip_il.tasks.points import point_names
from manip_il.tasks.table import TASKS, get_task
from manip_il.tasks.task import objects_in, phases


class RestorableEnvironment(Environment, Protocol):
    """An environment that a rollout job runs."""

    @property
    def task_description(self) -> str:
        """Instruction of the episode, for policies that read language."""
        ...

    def set_state(self, state: State) -> None:
        """Restore a state."""
        ...


class Simulation(Protocol):
    """All that rollouts, datasets, checkpoints and evaluations ask of a simulation."""

    @property
    def shares_models(self) -> bool:
        """Whether environments of one configuration share one compiled model."""
        ...

    def make(
        self, config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
    ) -> RestorableEnvironment:
        """Make an environment. Raises `UsageError` for cameras or conditions that it does not have."""
        ...

    def expert(self, config: EnvConfig) -> Labeller:
        """Make an expert."""
        ...

    def actions(self, config: EnvConfig) -> ActionSpace:
        """Return names, bounds and scale of actions, (n,)."""
        ...

    def spec(self, config: EnvConfig, cameras: CameraConfig | None = None) -> RobotTaskSpec:
        """Return what datasets and policies for the environment share."""
        ...

    def model_bytes(self, config: EnvConfig) -> bytes:
        """Return the compiled model, for a fingerprint."""
        ...

    def positions(self, config: EnvConfig, state: State) -> Mapping[str, NDArray[np.float64]]:
        """Return positions (3,) [m] in a state: `hand`, objects, and `goal`, where they are to go."""
        ...


class Scenes:
    """Our scenes, of a robot and a task."""

    shares_models = True

    def make(
        self, config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
    ) -> ManipEnv:
        """Make an environment."""
        return ManipEnv.of(config, cameras, conditions)

    def expert(self, config: EnvConfig) -> Expert:
        """Make an expert."""
        return Expert(_scene(config))

    def actions(self, config: EnvConfig) -> ActionSpace:
        """Return the robot's actions, (n,)."""
        return _scene(config).actions

    def spec(self, config: EnvConfig, cameras: CameraConfig | None = None) -> RobotTaskSpec:
        """Return names, sizes and rate."""
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

    def model_bytes(self, config: EnvConfig) -> bytes:
        """Return the scene's compiled model."""
        return _scene(config).model_bytes()

    def positions(self, config: EnvConfig, state: State) -> Mapping[str, NDArray[np.float64]]:
        """Return positions (3,) [m]; the first object that the episode is about is called `object`."""
        world, task = _world(config.robot, config.task, config.object), get_task(config.task, config.object)
        world.restore(state.physics, state.variation)
        found = {"hand": world.ee.position, "goal": task.destination(world)}
        for name in world.scene.objects:
            found["object" if name in objects_in(task, world)[:1] else name] = world.pose(name).position
        return found


SIMULATIONS: dict[str, Simulation] = {STOCK: StockSimulation()}
_SCENES = Scenes()


def is_known(robot: str, task: str) -> bool:
    """Return whether there is an environment of this robot and task here."""
    return task in STOCK_TASKS if robot == STOCK else robot in ROBOTS and task in TASKS


def simulation_of(robot: str) -> Simulation:
    """Return the simulation of a robot."""
    return SIMULATIONS.get(robot, _SCENES)


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
