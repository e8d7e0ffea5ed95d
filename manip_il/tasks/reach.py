"""Reach: move the hand to a goal in the air."""

import math
from types import MappingProxyType

import mujoco
import numpy as np

from manip_il.robots.geometry import hand_down
from manip_il.sim.task import Observed, Rung, Start, Target, Task
from manip_il.sim.world import GOAL, World
from manip_il.tasks.ladder import AT_GOAL, CLOSED, nearness
from manip_il.tasks.objects import CUBE_HALF, add_goal, observe_hand
from manip_il.tasks.starts import UPRIGHT, draw_goal


def _to_goal(world: World) -> Target:
    return Target(world.goal, hand_down(world.ahead(world.goal)), CLOSED)


class ReachGoal(Task):
    """Bring `ee` to the goal."""

    name = "reach"
    instruction = "Move the hand to the green goal."
    place = "the green goal"
    subtasks = MappingProxyType({"carry": "move {it} to {place}"})
    rungs = (
        Rung("at_goal", lambda w: math.dist(w.goal, w.ee.position) < AT_GOAL, _to_goal),
        Rung("carry", lambda w: True, _to_goal),
    )

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the goal."""
        add_goal(spec)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw a goal over the table."""
        return Start({GOAL: (draw_goal(rng, world, CUBE_HALF, in_air=1.0), UPRIGHT)})

    def observe(self, world: World) -> Observed:
        """Return hand, goal, and the vector between them."""
        return {
            **observe_hand(world),
            "goal": world.goal,
            "goal_from_ee": world.goal - world.ee.position,
        }

    def error(self, world: World) -> float:
        """Return the distance of `ee` from the goal [m]."""
        return math.dist(world.ee.position, world.goal)

    def progress(self, world: World) -> float:
        """Return progress by the distance left."""
        return nearness(self.error(world))
