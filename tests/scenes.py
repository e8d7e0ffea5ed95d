"""Environments at a start, and the expert that drives them on."""

from typing import Any

import numpy as np

from manip_il import Expert
from manip_il.sim.conditions import Condition
from manip_il.sim.env import ManipEnv
from manip_il.sim.task import phases
from manip_il.sim.world import GOAL, World
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import make_env, scene_of

SEED = 5_000_000
SIZES = Condition("sizes", size=(0.03, 0.07), mass=(0.05, 0.3))


def sizes_of(task: str) -> list[Condition]:
    """The other sizes and masses that a task can take."""
    varied = SIZES.for_world(
        has_object=bool(TASKS[task].objects), sees=False, sizes=TASKS[task].sizes
    )
    return [] if varied is None else [varied]


def started(
    robot: str = "panda", task: str = "pick_place", seed: int = SEED, **settings: Any
) -> ManipEnv:
    env = make_env(robot, task, **settings)
    env.start(seed)
    return env


def world_at_home(robot: str, task: str = "pick_place") -> World:
    """The arm as its YAML says it starts; call `update` after a change."""
    world = World(scene_of(robot, task))
    world.data.qpos[world.scene.arm_q] = world.scene.robot.home
    world.update()
    return world


def has_goal(world: World) -> bool:
    """Whether the task shows where things are to go."""
    return any(world.model.body(number).name == GOAL for number in range(world.model.nbody))


def still(env: ManipEnv, opening: float | None = None) -> np.ndarray:
    """The action that holds the arm where it is commanded to be, and the fingers where they are
    or at an opening.
    """
    return env.scene.actions.join(
        env.data.ctrl[env.scene.arm_ctrl], env.world.opening if opening is None else opening
    )


def bits(env: ManipEnv) -> bytes:
    return env.get_state().to_vector().tobytes()


def cube(env: ManipEnv) -> np.ndarray:
    """Position of what is grasped [m]."""
    return env.data.joint(env.scene.task.grasped[0]).qpos[:3].copy()


def half_height(world: World, name: str) -> float:
    """Half the height of an object as it lies, its faces level or upright [m]."""
    return float(np.abs(world.pose(name).rotation[2]) @ np.array(world.extents(name))) / 2


def in_hand(env: ManipEnv) -> np.ndarray:
    """The cube's position in the hand's frame [m]."""
    return env.world.ee.rotation.T @ (cube(env) - env.world.ee.position)


def drive(env: ManipEnv, steps: int) -> None:
    """Let the expert drive for so many control steps."""
    expert = Expert(env.scene)
    for _ in range(steps):
        env.advance(expert.label(env.get_state()).action)


def solve(env: ManipEnv) -> list[str]:
    """Let the expert solve the task; return the phases on the way."""
    expert, names, seen = Expert(env.scene), phases(env.scene.task), list[str]()
    while not env.solved:
        assert env.get_state().step < env.config.horizon
        label = expert.label(env.get_state())
        seen.append(names[label.phase])
        env.advance(label.action)
    return seen


def drive_until(env: ManipEnv, phase: str) -> None:
    """Let the expert drive until its label is of a phase."""
    expert, names = Expert(env.scene), phases(env.scene.task)
    for _ in range(60):
        label = expert.label(env.get_state())
        if names[label.phase] == phase:
            return
        env.advance(label.action)
    raise AssertionError(f"the expert never reached {phase!r}")
