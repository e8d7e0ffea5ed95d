"""Pick and place: a cube from the table to a goal on it or in the air."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from manip_il.sim.world import GOAL, World
from manip_il.tasks.grasp import lie_of
from manip_il.tasks.ladder import pick_progress, pick_rungs
from manip_il.tasks.objects import add_cube, add_goal
from manip_il.tasks.reach import observe_hand
from manip_il.tasks.starts import UPRIGHT, draw_goal, draw_resting, draw_yaw, resting_height
from manip_il.tasks.task import Limits, Observed, Rung, Start

OBJECT = "object"


@dataclass(frozen=True)
class PickPlace:
    """Bring the cube's centre to the goal. Ranges are those of gymnasium-robotics' FetchPickAndPlace."""

    name: str = "pick_place"
    instruction: str = "Pick up the cube and bring it to the green goal."
    limits: Limits = Limits()
    objects: tuple[str, ...] = (OBJECT,)
    grasped: tuple[str, ...] = (OBJECT,)
    rungs: tuple[Rung, ...] = pick_rungs(OBJECT)

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the cube and the goal."""
        add_cube(spec, OBJECT)
        add_goal(spec)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the cube on the table, at any yaw, and the goal, half of the time in the air."""
        at, turn = draw_resting(rng, world, OBJECT), draw_yaw(rng)
        goal = draw_goal(rng, world, resting_height(world, OBJECT))
        return Start({OBJECT: (at, turn), GOAL: (goal, UPRIGHT)})

    def observe(self, world: World) -> Observed:
        """Return hand, goal, cube, and the ways between them; four times the cube's yaw, as its faces are alike."""
        return observe_cube(world, OBJECT)

    def error(self, world: World) -> float:
        """Return the distance of the cube's centre from the goal [m]."""
        return math.dist(world.pose(OBJECT).position, world.goal)

    def progress(self, world: World) -> float:
        """Return progress by the way that is left along the ladder's path."""
        return pick_progress(world, OBJECT)


def observe_cube(world: World, name: str) -> Observed:
    """Return `environment_state` of a task with one cube and a goal for it."""
    goal = world.goal
    way = goal - world.pose(name).position
    return {**observe_hand(world), "goal": goal, **observe_object(world, name), f"goal_from_{name}": way}


def observe_object(world: World, name: str) -> Observed:
    """Return an object's position, yaw modulo its symmetry, tilt and width, and the way to it from the hand."""
    position, lie = world.pose(name).position, lie_of(world, name)
    return {
        name: position,
        f"{name}.cos4yaw": math.cos(4 * lie.yaw),
        f"{name}.sin4yaw": math.sin(4 * lie.yaw),
        f"{name}.tilt": lie.tilt,
        f"{name}.width": world.extents(name)[0],
        f"{name}_from_ee": position - world.ee.position,
    }
