"""Pick and place: move an object to a goal on the table or in the air.

Lift: to a goal above its start. Reach: move the hand alone to a goal in the air.
"""

import math
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Self

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import hand_down
from manip_il.sim.shape import CUBE, ObjectShape
from manip_il.sim.task import CUBE_SIZES, Observed, Rung, Start, Target, Task
from manip_il.sim.world import GOAL, World
from manip_il.tasks.grasp import lie_of
from manip_il.tasks.ladder import AT_GOAL, CLOSED, is_held, nearness, pick_progress, pick_rungs
from manip_il.tasks.objects import (
    CUBE_HALF,
    CUBE_MASS,
    RED,
    UPRIGHT,
    add_goal,
    add_object,
    draw_few,
    draw_goal,
    draw_lying,
    draw_until,
    observe_hand,
    observe_object,
)

OBJECT = "object"
LIFT = (0.1, 0.25)  # height of a lift's goal above the object's start [m]
# workspace height from which the full `LIFT` is used; lower workspaces scale it down [m]
LIFT_HEIGHT = 0.45
ANY_SHAPE = 200  # horizon: small or rolling objects take more attempts than a cube


@dataclass(frozen=True)
class PickPlace(Task):
    """Bring the object's centre to the goal.

    The ranges are those of gymnasium-robotics' FetchPickAndPlace.

    Attributes:
        shape: The object's shape, a 5 cm cube unless `--task.object=` says otherwise.
    """

    name: str = "pick_place"
    instruction: str = "Pick up the cube and bring it to the green goal."
    place = "the green goal"
    horizon: int = 100
    objects = (OBJECT,)
    grasped = (OBJECT,)
    sizes: tuple[float, float] | None = CUBE_SIZES
    rungs = pick_rungs(OBJECT)
    shape: ObjectShape = CUBE

    def with_shape(self, shape: ObjectShape) -> Self:
        """Return the task with another object, which its instruction also names."""
        instruction = self.instruction.replace(self.shape.word, shape.word)
        horizon = self.horizon if shape == CUBE else ANY_SHAPE
        return replace(
            self, shape=shape, sizes=shape.sizes, instruction=instruction, horizon=horizon
        )

    def noun(self, name: str) -> str:
        """Return the words for an object or a place of a given name."""
        return self.shape.word if name == OBJECT else super().noun(name)

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the object and the goal."""
        shape = self.shape
        mass = CUBE_MASS if shape == CUBE else shape.mass
        add_object(spec, OBJECT, shape.kind, shape.size, mass, RED, shape.mesh)
        add_goal(spec)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the object on the table, lying or standing at any yaw, and the goal.

        The goal is in the air half of the time.
        """
        at, turn = draw_lying(rng, world, OBJECT)
        goal = draw_goal(rng, world, float(at[2]))
        return Start({OBJECT: (at, turn), GOAL: (goal, UPRIGHT)})

    def observe(self, world: World) -> Observed:
        """Return the hand, the goal, the object, and the vectors between them.

        The object is described by `observe_object`.
        """
        return {
            **observe_hand(world),
            "goal": world.goal,
            **observe_object(world, OBJECT),
            f"goal_from_{OBJECT}": world.goal - world.at(OBJECT),
        }

    def error(self, world: World) -> float:
        """Return the distance of the object's centre from the goal [m]."""
        return math.dist(world.at(OBJECT), world.goal)

    def unsound(self, world: World) -> str:
        """Return why there is no sound label, or "" if there is one.

        There is none if the mesh, as it lies, is too wide or too low for the gripper.
        """
        if lie_of(world, OBJECT).fits or is_held(world, OBJECT):
            return ""
        return f"{OBJECT} lies on a side on which it is too low or too wide for the gripper"

    def progress(self, world: World) -> float:
        """Return progress by the distance left along the ladder's path."""
        return pick_progress(world, OBJECT)


@dataclass(frozen=True)
class Lift(PickPlace):
    """Pick and place with the goal above the object."""

    name: str = "lift"
    instruction: str = "Lift the cube to the green goal above it."
    horizon: int = 150

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the object on the table, and the height of the goal over it.

        The object lies or stands at any yaw.
        """
        low, high = np.array(LIFT) * min(1.0, world.robot.workspace.height / LIFT_HEIGHT)

        def draw_both() -> dict[str, tuple[F64, F64]]:
            at, turn = draw_lying(rng, world, OBJECT)
            goal = draw_few(lambda: at + [0.0, 0.0, rng.uniform(low, high)], world.reach.has)
            return {} if goal is None else {OBJECT: (at, turn), GOAL: (goal, UPRIGHT)}

        return Start(draw_until(draw_both, bool, world, "the goal"))


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
