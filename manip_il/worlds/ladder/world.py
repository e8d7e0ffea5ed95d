"""Our robots at our tasks, behind the contract of a world."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from manip_il.checks import check_unchanged
from manip_il.mdp import F64, STATE_EXTRAS, State
from manip_il.robots import ROBOTS
from manip_il.robots.files import ModelFiles
from manip_il.robots.spec import model_bytes
from manip_il.robots.table import get_robot, is_robot
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.sim.env import ManipEnv, environment_state_names
from manip_il.sim.mesh import mesh_path
from manip_il.sim.points import point_names
from manip_il.sim.props import VERSION as DRAWN
from manip_il.sim.shape import MESH, ObjectShape, stored
from manip_il.sim.task import phases
from manip_il.sim.variation import with_drawn
from manip_il.tasks import ENV_IDS
from manip_il.tasks.table import TASKS, get_task, is_task, source_hash
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import OPENINGS, SERVOS, Environment, EnvironmentSpec, Outcome, WorldKind
from manip_il.worlds.fingerprint import environment_fingerprint
from manip_il.worlds.ladder.envs import config_scene, parts_of
from manip_il.worlds.ladder.expert import LadderExpert
from manip_il.worlds.ladder.redraw import redrawn

LIMITS_HZ = 20  # control rate for which tasks give their limits [Hz]; at other rates they last as many seconds
_TURNED = ("carry", "insert", "insert_tight", "press")  # tasks whose furniture older versions rendered without its yaw


class LadderEnv(ManipEnv, Environment):
    """`ManipEnv` behind the contract, whose `step` it has in place of gymnasium's."""

    def __init__(self, config: EnvConfig, cameras: CameraConfig | None, conditions: Sequence[Condition]):
        super().__init__(*parts_of(config), config, cameras=cameras, conditions=conditions)
        self.actions = self.scene.actions
        self._object = stored(config.object)

    @property
    @override
    def spec(self) -> EnvironmentSpec:  # pyright: ignore[reportIncompatibleVariableOverride]  # of gymnasium
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
        )

    @override
    def step(self, action: NDArray[Any]) -> Outcome:  # pyright: ignore[reportIncompatibleMethodOverride]
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
    def varied(self, state: State, drawn: Mapping[str, Any]) -> State:
        return replace(state, variation=with_drawn(state.variation, drawn))

    @override
    def redrawn(self, state: State, rng: np.random.Generator) -> State | None:
        return redrawn(self.world, state, rng)


class LadderKind(WorldKind):
    """Robots and tasks by name or by the path of a user's own file."""

    @override
    def complete(self, config: EnvConfig) -> EnvConfig:
        """Canonicalise the object (the default becomes "") and the task's argument; fill in rate and task."""
        task, robot = get_task(config.task), get_robot(config.robot)
        for file in (config.task, config.robot, mesh_path(config.object)):
            if isinstance(file, Path):
                check_unchanged(file)
        if task.argument_bodies:
            config = replace(config, task=task.name)
        if config.object:
            shape, other = ObjectShape.parse(config.object), get_task(config.task, config.object)
            is_own = shape == task.shape
            named = config.object if isinstance(config.object, Path) else str(shape)
            task, config = task if is_own else other, replace(config, object="" if is_own else named)
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
        return LadderEnv(config, cameras, conditions)

    @override
    def expert(self, config: EnvConfig) -> LadderExpert:
        return LadderExpert(config_scene(config))

    @override
    def fingerprint(self, config: EnvConfig) -> dict[str, str]:
        robot, task = parts_of(config)
        name, _, argument = task.name.partition(":")
        settings = asdict(config) | {"robot": robot.name, "task": name, "object": stored(config.object)}
        settings |= {"reward": argument} if argument else {}  # as in older fingerprints, where only carry has it
        if not config.object:  # as in fingerprints of versions that had no `object`
            del settings["object"]
        own = {} if name in TASKS else {"task_sha256": source_hash(task)}
        if robot.name not in ROBOTS:  # a user's own robot: hash its values, not its files' paths
            said = replace(robot, files=ModelFiles(Path()), gripper=replace(robot.gripper, files=None))
            own["robot_sha256"] = hashlib.sha256(repr(said).encode()).hexdigest()
        if config.object and (mesh := ObjectShape.parse(config.object).mesh):
            own["object_sha256"] = mesh.sha256
        return environment_fingerprint(model_bytes(config_scene(config).model), settings) | own

    @override
    def drawing_version(self, config: EnvConfig) -> int:
        return DRAWN + (str(config.task).partition(":")[0] in _TURNED)

    @override
    def own_files(self, robot: str, task: str, shape: str) -> list[str]:
        robots = [] if is_robot(robot) else ["--robot.type=FILE.yaml"]
        meshes = ["--task.object=mesh:FILE:LENGTH"] if shape.startswith(MESH) else []
        return [*robots, *([] if is_task(task) else ["--task.type=FILE.py"]), *meshes]

    @override
    def lerobot_words(self, robot: str, task: str) -> list[str]:
        name, colon, argument = task.partition(":")
        named = next((env_id for env_id, names in ENV_IDS.items() if names == (robot, name)), None)
        return ["--env.type=manip_il", f"--env.task={named.partition('/')[2]}{colon}{argument}"] if named else []

    @override
    def success(self, tolerance: float, steps: int) -> str:
        return f"an error of at most {100 * tolerance:g} cm for {steps} control steps in a row"

    @override
    def affecting(self, config: EnvConfig, condition: Condition, *, sees: bool) -> Condition | None:
        task = get_task(config.task, config.object)
        return condition.for_world(has_object=bool(task.objects), sees=sees, sizes=task.sizes)


WORLD = LadderKind()
