"""Our robots at our tasks, behind the contract of a world.

New scenes from visited states: new goals, and new places of untouched objects.

Scenes and environments by the names of robot and task.
"""

import colorsys
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, override

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.checks import check_unchanged
from manip_il.mdp import F64, STATE_EXTRAS, State
from manip_il.option import NameOrPath
from manip_il.own_file import source_hash
from manip_il.robots import ROBOTS
from manip_il.robots.robot import ModelFiles, Robot
from manip_il.robots.spec import model_bytes
from manip_il.robots.table import get_robot
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.sim.env import ManipEnv, environment_state_names
from manip_il.sim.mesh import mesh_path
from manip_il.sim.render import LOOK_VERSION as DRAWN
from manip_il.sim.render import point_names
from manip_il.sim.scene import Scene, build_scene
from manip_il.sim.shape import ObjectShape, stored
from manip_il.sim.task import Task, phases
from manip_il.sim.variation import part, with_drawn
from manip_il.sim.world import World
from manip_il.tasks import ENV_IDS
from manip_il.tasks.table import TASKS, get_task
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import (
    OPENINGS,
    SERVOS,
    Environment,
    EnvironmentSpec,
    Outcome,
    WorldKind,
)
from manip_il.worlds.fingerprint import environment_fingerprint
from manip_il.worlds.ladder.expert import LadderExpert
from manip_il.worlds.table import make_config, world_of
from manip_il.worlds.table import make_env as any_env


def scene_of(robot: NameOrPath, task: NameOrPath, shape: NameOrPath = "") -> Scene:
    """Return the compiled scene of a robot, a task and an object.

    Args:
        robot: Its name, or the `Path` of its YAML.
        task: Its name, or the `Path` of its Python file.
        shape: The object, as in `EnvConfig`; empty for the task's default.

    Raises:
        UnknownName: for a robot or a task.
        UsageError: if the scene cannot be built.
    """
    return build_scene(get_robot(robot), get_task(task, shape))


def config_scene(config: EnvConfig) -> Scene:
    """Return the compiled scene of an environment."""
    return build_scene(*parts_of(config), config.physics_step)


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
) -> ManipEnv | Any:
    """Return the environment of a robot and a task: a `ManipEnv`, or another world's `Environment`.

    Args:
        robot: Its name, or the path of its YAML, or of a world's Python file.
        task: Its name, or the path of its Python file.
        cameras: Names of the cameras rendered in every step.
        image_size: Height and width of their pictures [pixels].
        look: As in `ManipEnv`.
        render_mode: As in `ManipEnv`; other worlds have none.
        conditions: As in `ManipEnv`.
        settings: Other fields of `EnvConfig`.

    Raises:
        UnknownName: for a robot, a task, a camera or a `render_mode`.
        UsageError: for any other wrong value.
    """
    config = make_config(robot, task, **settings)
    seen = CameraConfig(tuple(cameras), *image_size, look or Look()) if cameras else None
    if world_of(config.robot, config.task) is not WORLD:
        return any_env(config, seen, conditions)
    return ManipEnv(
        *parts_of(config),
        config,
        cameras=seen,
        look=look,
        render_mode=render_mode,
        conditions=conditions,
    )


def parts_of(config: EnvConfig) -> tuple[Robot, Task]:
    """Return the robot and the task of an environment."""
    return get_robot(config.robot), get_task(config.task, config.object)


# shares: new goals, moved objects, moved objects placed near the hand
GOALS = 0.8
OBJECTS = 0.7
NEAR = 0.5
_UNTOUCHED = 0.04  # least distance of an untouched object's centre from the hand [m]
_AROUND = 0.04  # standard deviation of an object's place near the hand, in x and y [m]
_DEEP = 1e-3  # largest overlap of a moved object with another [m]


def redrawn(world: World, visited: State, rng: np.random.Generator) -> State | None:
    """Return a scene with new goals and new places of untouched objects.

    Args:
        world: The world in which the scene is made; its own state is lost.
        visited: The state that is changed into the scene.
        rng: Draws what changes.

    Returns:
        The new state; None if the drawn places overlap.
    """
    task = world.scene.task
    world.restore(visited.physics, visited.variation)
    free, markers = _untouched(world), _markers(world.model)
    poses = task.draw(rng, world).poses
    new_goals, moved = rng.uniform() < GOALS, list[int]()
    for name, (at, turn) in poses.items():
        body = world.scene.model.body(name).id
        if name in task.argument_bodies:
            continue
        if body in markers:
            if new_goals:
                world.place(name, at, turn)
        elif body in free and rng.uniform() < OBJECTS:
            near = name in world.scene.objects and rng.uniform() < NEAR
            world.place(name, _near_hand(world, at, rng) if near else at, turn)
            moved.append(body)
    world.update()
    roots, depths = _contacts(world)
    overlaps = np.isin(roots, moved).any(axis=1) & (roots[:, 0] != roots[:, 1]) & (depths > _DEEP)
    return None if overlaps.any() else replace(visited, physics=world.physics())


def _untouched(world: World) -> set[int]:
    """Return bodies of objects and furniture that are at rest and touch only what is fixed to
    the world.
    """
    model, (roots, _) = world.model, _contacts(world)
    touched = set(roots[(roots > 0).all(axis=1) & (roots[:, 0] != roots[:, 1])].ravel().tolist())
    ee = world.ee.position.tolist()
    free = {
        one.body
        for name, one in world.scene.objects.items()
        if world.at_rest(name) and math.dist(world.pose(name).position.tolist(), ee) > _UNTOUCHED
    }
    return (free | {body for body in range(model.nbody) if model.body_mocapid[body] >= 0}) - touched


@lru_cache(1)
def _markers(model: mujoco.MjModel) -> set[int]:
    """Return the bodies that mark goals: mocap bodies without collisions."""
    solid = set(model.body_rootid[model.geom_bodyid[model.geom_contype > 0]].tolist())
    return {
        body for body in range(model.nbody) if model.body_mocapid[body] >= 0 and body not in solid
    }


def _near_hand(world: World, at: F64, rng: np.random.Generator) -> F64:
    """Return a random place around the hand, at the height of `at`, (3,) [m]."""
    return np.append(world.ee.position[:2] + rng.normal(0.0, _AROUND, 2), at[2])


def _contacts(world: World) -> tuple[NDArray[np.int32], F64]:
    """Return the root bodies of every contact, (C, 2), and its depth [m], (C,)."""
    model, contacts = world.model, world.data.contact
    mujoco.mj_collision(model, world.data)
    return model.body_rootid[model.geom_bodyid[contacts.geom]], -contacts.dist


# control rate for which tasks give their limits [Hz]; at other rates they last as many seconds
LIMITS_HZ = 20
_HUES = ("red", "yellow", "green", "cyan", "blue", "magenta")  # a sixth of a turn apart
_GREYISH = 0.2  # saturation below which a colour has no hue
# tasks whose furniture older versions rendered without its yaw
_TURNED = ("carry", "insert", "insert_tight", "press")


class LadderEnv(ManipEnv, Environment):
    """`ManipEnv` behind the contract, whose `step` it has in place of gymnasium's.

    Args:
        config: Settings of the environment, complete.
        cameras: Cameras rendered in every step; None for none.
        conditions: How episodes differ from the nominal world, in turn by seed.
        robot: The robot; by default the one that `config` names.
    """

    def __init__(
        self,
        config: EnvConfig,
        cameras: CameraConfig | None = None,
        conditions: Sequence[Condition] = (),
        robot: Robot | None = None,
    ):
        named, task = parts_of(config)
        super().__init__(robot or named, task, config, cameras=cameras, conditions=conditions)
        self.actions = self.scene.actions
        self._object = stored(config.object)

    @property
    @override
    def spec(  # pyright: ignore[reportIncompatibleVariableOverride]  # of gymnasium
        self,
    ) -> EnvironmentSpec:
        scene, task = self.scene, self._task
        servos = scene.robot.lerobot
        return EnvironmentSpec(
            robot=scene.robot.name,
            task=task.name,
            fps=self.config.control_hz,
            joint_names=scene.robot.joint_names,
            environment_state_names=environment_state_names(scene),
            sim_state_size=scene.state_size + len(scene.nominal) + STATE_EXTRAS,
            instruction=task.instruction,
            phases=phases(task),
            object=self._object,
            action_meaning=SERVOS if servos else OPENINGS,
            robot_type=servos.robot_type if servos else "",
            horizon=self.config.horizon,
            can=("restored", "varied", "redrawn", "perturbed", "drawn", "shown in a window"),
            all_cameras=CAMERAS,
            default_cameras=CAMERAS,
            points=point_names(scene),
            drawing_version=DRAWN + (task.name.partition(":")[0] in _TURNED),
        )

    @override
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, action: NDArray[Any]
    ) -> Outcome:
        return Outcome(self.advance(action), self.reward, self.solved)

    @override
    def positions(self) -> dict[str, F64]:
        world = self.world
        found = {"hand": world.ee.position}
        for name in world.scene.objects:
            is_first = name in self._task.objects_in(world)[:1]
            found["object" if is_first else name] = world.pose(name).position
        return found

    @override
    def subtask(self, phase: int) -> str:
        return self._task.subtask(self.world, self.spec.phases[phase]) if phase else ""

    @override
    def noun(self, name: str) -> str:
        if name == "object":
            [name] = self._task.objects_in(self.world)[:1]
        return self._task.noun(name)

    @override
    def facts(self) -> list[tuple[str, str, Any]]:
        found = super().facts()
        for name, one in self.scene.objects.items():
            noun = self._task.noun(name)
            found.append((noun, "state", "held" if self.world.touched(name) else "free"))
            found.append((noun, "color", self._colour(one.geom)))
        return found

    def _colour(self, geom: int) -> str:
        """Return the name of an object's colour in pictures."""
        model, drawn = self.scene.model, part(self.world.variation, "colour")
        material = model.geom_matid[geom]
        own = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        red, green, blue = own[:3] if (drawn < 0).any() else drawn
        hue, saturation, value = colorsys.rgb_to_hsv(red, green, blue)
        if saturation < _GREYISH:
            return "white" if value > 0.7 else "grey" if value > 0.2 else "black"
        return _HUES[round(hue * len(_HUES)) % len(_HUES)]

    @override
    def varied(self, state: State, drawn: Mapping[str, Any]) -> State:
        return replace(state, variation=with_drawn(state.variation, drawn))

    @override
    def redrawn(self, state: State, rng: np.random.Generator) -> State | None:
        return redrawn(self.world, state, rng)


class LadderKind(WorldKind):
    """Robots and tasks by name or by the path of a user's own file."""

    @override
    def complete(self, config: EnvConfig) -> EnvConfig:
        """Canonicalise the object (the default becomes "") and the task's argument.

        Fill in rate and task.
        """
        robot = get_robot(config.robot)
        task = get_task(config.task)
        for file in (config.task, config.robot, mesh_path(config.object)):
            if isinstance(file, Path):
                check_unchanged(file)
        if task.argument_bodies:
            config = replace(config, task=task.name)
        if config.object:
            shape, other = ObjectShape.parse(config.object), get_task(config.task, config.object)
            is_own = shape == task.shape
            named = config.object if isinstance(config.object, Path) else str(shape)
            task, config = (
                task if is_own else other,
                replace(config, object="" if is_own else named),
            )
        control_hz = config.control_hz or robot.fps
        rate = control_hz / LIMITS_HZ
        return replace(
            config,
            control_hz=control_hz,
            tolerance=config.tolerance or task.tolerance,
            success_steps=config.success_steps or max(1, round(task.success_steps * rate)),
            horizon=config.horizon or max(1, round(task.horizon * rate)),
        )

    @override
    def environment(
        self, config: EnvConfig, cameras: CameraConfig | None, conditions: Sequence[Condition]
    ) -> LadderEnv:
        """Return the environment of a robot at a task.

        Args:
            config: Its settings, complete.
            cameras: Cameras rendered in every step; None for none.
            conditions: How episodes differ from the nominal world, in turn by seed.
        """
        return LadderEnv(config, cameras, conditions)

    @override
    def expert(self, config: EnvConfig) -> LadderExpert:
        return LadderExpert(config_scene(config))

    @override
    def fingerprint(self, config: EnvConfig) -> dict[str, str]:
        robot, task = parts_of(config)
        name, _, argument = task.name.partition(":")
        settings = asdict(config) | {
            "robot": robot.name,
            "task": name,
            "object": stored(config.object),
        }
        # as in older fingerprints, where only carry has it
        settings |= {"reward": argument} if argument else {}
        if not config.object:  # as in fingerprints of versions that had no `object`
            del settings["object"]
        own = {} if name in TASKS else {"task_sha256": source_hash(type(task))}
        if robot.name not in ROBOTS:  # a user's own robot: hash its values, not its files' paths
            said = replace(
                robot, files=ModelFiles(Path()), gripper=replace(robot.gripper, files=None)
            )
            own["robot_sha256"] = hashlib.sha256(repr(said).encode()).hexdigest()
        if robot.servos:
            own["servos_sha256"] = hashlib.sha256(repr(robot.servos).encode()).hexdigest()
        if config.object and (mesh := ObjectShape.parse(config.object).mesh):
            own["object_sha256"] = mesh.sha256
        return environment_fingerprint(model_bytes(config_scene(config).model), settings) | own

    @override
    def lerobot_words(self, robot: str, task: str) -> list[str]:
        name, colon, argument = task.partition(":")
        named = next((env_id for env_id, names in ENV_IDS.items() if names == (robot, name)), None)
        return (
            ["--env.type=manip_il", f"--env.task={named.partition('/')[2]}{colon}{argument}"]
            if named
            else []
        )

    @override
    def affecting(self, config: EnvConfig, condition: Condition, *, sees: bool) -> Condition | None:
        """Return the part of a condition that changes something for this task and policy.

        Args:
            config: Settings of the environment.
            condition: Ranges of what differs from the nominal world.
            sees: Whether the policy has cameras.

        Returns:
            The condition as `Condition.for_world` returns it; None if nothing in it has an effect.

        Raises:
            UsageError: if the task can take none of the condition's object sizes.
        """
        task = get_task(config.task, config.object)
        return condition.for_world(
            has_object=bool(task.objects),
            sees=sees,
            sizes=task.sizes,
            named=not task.nouns.keys().isdisjoint(task.objects),
            servos=bool(get_robot(config.robot).servos),
        )


WORLD = LadderKind()
