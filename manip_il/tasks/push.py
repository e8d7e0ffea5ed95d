"""Push: a puck to a goal on the table, without grasping it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import GOAL, World
from manip_il.tasks.grasp import LOWEST_EE, hand_down
from manip_il.tasks.ladder import AT_GOAL, nearness
from manip_il.tasks.objects import RED, add_goal, add_object
from manip_il.tasks.reach import observe_hand
from manip_il.tasks.starts import UPRIGHT, draw_resting, draw_until, resting_height
from manip_il.tasks.task import Limits, Observed, Rung, Start, Target

F64 = NDArray[np.float64]

PUCK = "puck"
PUCK_SIZE = (0.03, 0.02)  # radius, half its height [m]
PUCK_MASS = 0.15  # [kg]
BEHIND = 0.05  # of the hand from the puck's middle, where it stands behind it [m]
PUSHING = (0.01, 0.12)  # of the hand behind the puck's middle while it pushes: no nearer, no farther [m]
BESIDE = 0.02  # of the hand off the line through puck and goal while it pushes [m]
LOW = LOWEST_EE + 0.004  # of the hand while it pushes [m]
LOW_ENOUGH = 0.05  # under this height it pushes [m]
ABOVE = 0.10  # of the hand on its way around the puck [m]
SLOPE = 2.0  # height the hand gains per distance from where it stands behind the puck
OPENING = 0.04  # of the fingers, across the push: the puck rests against both [m]
STEP = 0.03  # how far ahead of the hand its target runs while it pushes [m]
FAR = 0.08  # least distance of the goal from the puck at the start [m]
ROOM = 0.06  # within reach behind the puck at the start [m]


def _way(world: World) -> tuple[F64, float]:
    """Direction from puck to goal on the table (2,) and the distance [m]."""
    way = (world.goal - world.pose(PUCK).position)[:2]
    distance = math.hypot(*way)
    return (way / distance if distance > 1e-9 else np.array([1.0, 0.0])), distance


def _across(world: World, direction: F64) -> F64:
    """Rotation of a hand that points down with its fingers across the push: of two, the nearer one, (3, 3)."""
    hand = world.ee.rotation
    yaw, at = math.atan2(direction[1], direction[0]), math.atan2(hand[1, 0], hand[0, 0])
    turns = (yaw - math.pi, yaw, yaw + math.pi)
    return hand_down(min(turns, key=lambda turn: (abs(turn - at) + 0.3 * abs(turn), turn)))


def _behind(world: World) -> tuple[float, float]:
    """Distances of the hand behind the puck on the line to the goal, and beside that line [m]."""
    direction, _ = _way(world)
    x, y = (world.ee.position - world.pose(PUCK).position)[:2].tolist()
    return -(x * direction[0] + y * direction[1]), abs(x * direction[1] - y * direction[0])


def _at_goal(world: World) -> bool:
    return _way(world)[1] < AT_GOAL


def _stay(world: World) -> Target:
    """Hold the hand where it is."""
    return Target(world.ee.position.copy(), world.ee.rotation.copy(), OPENING)


def _pushes(world: World) -> bool:
    behind, beside = _behind(world)
    nearest, farthest = PUSHING
    return nearest < behind < farthest and beside < BESIDE and world.ee.position[2] < LOW_ENOUGH


def _push(world: World) -> Target:
    direction, distance = _way(world)
    behind, _ = _behind(world)
    on_line = world.pose(PUCK).position[:2] - direction * behind
    ahead = on_line + direction * (distance + max(0.0, behind - BEHIND))
    return Target(np.append(ahead, LOW), _across(world, direction), OPENING, max_step=STEP)


def _around(world: World) -> Target:
    """To behind the puck: up, over it and down, the nearer to there the lower; straight up if too low beside it."""
    direction, _ = _way(world)
    ee = world.ee.position
    to = world.pose(PUCK).position[:2] - direction * BEHIND
    off = math.hypot(*(to - ee[:2]))
    height = LOW + min(ABOVE, SLOPE * max(0.0, off - 0.01))
    sideways = min(1.0, max(0.0, 1.0 - (height - ee[2]) / 0.03))
    return Target(np.append(ee[:2] + sideways * (to - ee[:2]), height), _across(world, direction), OPENING)


def _near(world: World) -> bool:
    direction, _ = _way(world)
    to = world.pose(PUCK).position[:2] - direction * BEHIND
    return math.hypot(*(to - world.ee.position[:2])) < ABOVE / SLOPE


_RUNGS = (
    Rung("at_goal", "the puck is at the goal", _at_goal, _stay),
    Rung("push", "the hand is behind the puck and pushes it", _pushes, _push),
    Rung("descend", "the hand goes down behind the puck", _near, _around),
    Rung("approach", "the hand is on its way to behind the puck", lambda w: True, _around),
)


@dataclass(frozen=True)
class Push:
    """Push a puck to a goal. The goal is flat, and the puck is moved by contact alone."""

    name: str = "push"
    instruction: str = "Push the puck to the green goal."
    limits: Limits = Limits(horizon=200)
    objects: tuple[str, ...] = (PUCK,)
    grasped: tuple[str, ...] = ()
    sizes: tuple[float, float] | None = (0.055, 0.07)
    rungs: tuple[Rung, ...] = _RUNGS

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the puck and the goal."""
        add_object(spec, PUCK, "cylinder", PUCK_SIZE, PUCK_MASS, RED)
        add_goal(spec, flat=True)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the puck, and a goal some way off such that the hand reaches behind the puck."""
        at, height = draw_resting(rng, world, PUCK, ROOM + 0.02), resting_height(world, PUCK)
        space = world.scene.robot.workspace

        def fits(goal: F64) -> bool:
            way = goal - at
            distance = math.hypot(way[0], way[1])
            return distance > FAR and world.reach.has(goal) and world.reach.has(at - ROOM / distance * way)

        goal = draw_until(
            lambda: np.append(np.array(space.centre) + rng.uniform(-1, 1, 2) * space.half_width, height),
            fits, world, "the goal",
        )  # fmt: skip
        return Start({PUCK: (at, UPRIGHT), GOAL: (np.append(goal[:2], 0.001), UPRIGHT)})

    def observe(self, world: World) -> Observed:
        """Return hand, goal and puck, and the ways between them."""
        puck, ee, goal = world.pose(PUCK).position, world.ee.position, world.goal
        way = goal - puck
        return {
            **observe_hand(world),
            "goal": goal,
            PUCK: puck,
            "puck_from_ee": puck - ee,
            "goal_from_puck": way,
        }

    def destination(self, world: World) -> F64:
        """Return the goal, (3,) [m]."""
        return world.goal

    def error(self, world: World) -> float:
        """Return the distance of the puck from the goal on the table [m]."""
        return _way(world)[1]

    def progress(self, world: World) -> float:
        """Return progress by the way of hand and puck that is left."""
        direction, distance = _way(world)
        if _at_goal(world) or _pushes(world):
            return 0.5 + 0.5 * nearness(distance)
        to = np.append(world.pose(PUCK).position[:2] - direction * BEHIND, LOW)
        return 0.45 * nearness(math.dist(to, world.ee.position))
