"""Lift: a cube to a goal above where it lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.sim.task import Limits, Start
from manip_il.sim.world import GOAL, World
from manip_il.tasks.pick_place import OBJECT, PickPlace
from manip_il.tasks.starts import FEW_DRAWS, LIFT, LIFT_HEIGHT, UPRIGHT, draw_lying, draw_until

F64 = NDArray[np.float64]
UNDER = np.array([0.0, 0.0, -1.0])  # no hand gets there [m]


@dataclass(frozen=True)
class Lift(PickPlace):
    """Pick and place whose goal is above the cube."""

    name: str = "lift"
    instruction: str = "Lift the cube to the green goal above it."
    limits: Limits = Limits(horizon=150)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the object on the table, lying or standing at any yaw, and the height of the goal over it."""
        low, high = np.array(LIFT) * min(1.0, world.scene.robot.workspace.height / LIFT_HEIGHT)

        def draw_both() -> F64:
            at, turn = draw_lying(rng, world, OBJECT)
            goals = (at + [0.0, 0.0, rng.uniform(low, high)] for _ in range(FEW_DRAWS))
            goal = next((goal for goal in goals if world.reach.has(goal)), UNDER)
            return np.concatenate([goal, at, turn])

        both = draw_until(draw_both, lambda one: world.reach.has(one[:3]), world, "the goal")
        goal, at, turn = np.split(both, [3, 6])
        return Start({OBJECT: (at, turn), GOAL: (goal, UPRIGHT)})
