"""Lift: a cube to a goal above where it lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from manip_il.sim.world import GOAL, World
from manip_il.tasks.pick_place import OBJECT, PickPlace
from manip_il.tasks.starts import LIFT, UPRIGHT, draw_lying, draw_until
from manip_il.tasks.task import Limits, Start


@dataclass(frozen=True)
class Lift(PickPlace):
    """Pick and place whose goal is above the cube."""

    name: str = "lift"
    instruction: str = "Lift the cube to the green goal above it."
    limits: Limits = Limits(horizon=150)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the object on the table, lying or standing at any yaw, and the height of the goal over it."""
        at, turn = draw_lying(rng, world, OBJECT)
        goal = draw_until(lambda: at + [0.0, 0.0, rng.uniform(*LIFT)], world.reach.has, world, "the goal")
        return Start({OBJECT: (at, turn), GOAL: (goal, UPRIGHT)})
