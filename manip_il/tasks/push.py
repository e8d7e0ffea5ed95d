"""Push: move a puck to a goal on the table without grasping it."""

import math
from types import MappingProxyType
from typing import NamedTuple

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import hand_down
from manip_il.sim.task import Observed, Rung, Start, Target, Task
from manip_il.sim.world import GOAL, World
from manip_il.tasks.grasp import share
from manip_il.tasks.ladder import AT_GOAL, LiftProfile, nearness, rise_first
from manip_il.tasks.objects import (
    RED,
    UPRIGHT,
    add_goal,
    add_object,
    draw_resting,
    draw_until,
    draw_xy,
    observe_hand,
    resting_height,
)

PUCK = "puck"
PUCK_SIZE = (0.03, 0.02)  # radius, half its height [m]
PUCK_MASS = 0.15  # [kg]
PUSHING = (0.01, 0.12)  # range of the pushing hand's distance behind the puck's middle [m]
BESIDE = 0.02  # largest distance of the pushing hand from the line through puck and goal [m]
LOW = 0.004  # height of the pushing hand over its lowest position [m]
LOW_ENOUGH = 0.025  # the hand pushes below this height over `LOW` [m]
FUNNEL = LiftProfile(0.10, slope=2.0, free=0.01)  # height of the hand on its way around the puck
NEAR = 0.05  # distance from its place behind the puck at which the hand descends [m]
STEP = 0.03  # how far ahead of the hand its target runs while it pushes [m]
FAR = 0.08  # least distance of the goal from the puck at the start [m]
ROOM = 0.06  # reachable margin behind the puck at the start [m]


class PushStyle(NamedTuple):
    """Dimensions of a pushing hand.

    Attributes:
        behind: How far behind the puck's middle it starts [m].
        opening: The gap between the fingers, so that the puck rests against both [m].
        touching: How far behind the puck's middle it touches the puck [m].
        lower: The number that replaces `LOW_ENOUGH` at the distance `behind` [m].
    """

    behind: float
    opening: float
    touching: float
    lower: float


UPRIGHT_STYLE = PushStyle(0.05, 0.04, 0.0, LOW_ENOUGH)
# for a weak arm, which would otherwise come down on the puck
LEANING_STYLE = PushStyle(0.065, 0.02, 0.045, 0.006)


def _style(world: World) -> PushStyle:
    return LEANING_STYLE if world.robot.leans else UPRIGHT_STYLE


def _way(world: World) -> tuple[F64, float]:
    """Direction from puck to goal on the table (2,) and the distance [m]."""
    way = (world.goal - world.at(PUCK))[:2]
    distance = math.hypot(*way)
    return (way / distance if distance > 1e-9 else np.array([1.0, 0.0])), distance


def _across(world: World, direction: F64) -> F64:
    """Rotation of a downward hand with its fingers across the push, the nearer of two, (3, 3)."""
    yaw, puck = math.atan2(direction[1], direction[0]), world.at(PUCK)
    if world.robot.leans:
        at, turns = world.turned(puck), world.turns(yaw, math.pi, puck)
    else:
        at, turns = world.hand_yaw, [yaw - math.pi, yaw, yaw + math.pi]
    return hand_down(
        min(turns, key=lambda turn: (abs(turn - at) + 0.3 * abs(turn), turn)) + world.ahead(puck)
    )


def _hand(world: World) -> F64:
    """Return the point that pushes: the middle between the fingers at the pushing opening, (3,)
    [m].
    """
    return world.ee.position + world.ee.rotation[:, 1] * world.gripper.middle(_style(world).opening)


def _to(world: World, position: F64, direction: F64, max_step: float = 0.12) -> Target:
    """Target that puts the middle between the fingers at a position (3,) [m], across a push
    (2,).
    """
    rotation, opening = _across(world, direction), _style(world).opening
    return Target(
        position - rotation[:, 1] * world.gripper.middle(opening),
        rotation,
        opening,
        max_step=max_step,
    )


def _behind(world: World) -> tuple[float, float]:
    """Distances of the hand behind the puck on the line to the goal, and beside that line [m]."""
    direction, _ = _way(world)
    x, y, _ = _hand(world) - world.at(PUCK)
    return -(x * direction[0] + y * direction[1]), abs(x * direction[1] - y * direction[0])


def _pushes(world: World) -> bool:
    (behind, beside), style = _behind(world), _style(world)
    nearest, farthest = PUSHING
    apart = share((behind - style.touching) / (style.behind - style.touching))
    low_enough = world.robot.ee.lowest + LOW + LOW_ENOUGH - (LOW_ENOUGH - style.lower) * apart
    return nearest < behind < farthest and beside < BESIDE and world.ee.position[2] < low_enough


def _place_behind(world: World) -> F64:
    """Place of a hand that starts to push, (2,) [m]."""
    return world.at(PUCK)[:2] - _way(world)[0] * _style(world).behind


def _push(world: World) -> Target:
    direction, distance = _way(world)
    behind, _ = _behind(world)
    on_line = world.at(PUCK)[:2] - direction * behind
    ahead = on_line + direction * (distance + max(0.0, behind - _style(world).behind))
    return _to(world, np.append(ahead, world.robot.ee.lowest + LOW), direction, STEP)


def _around(world: World) -> Target:
    """Move over the puck to behind it, descending on the way.

    A hand too low beside it only rises.
    """
    hand, to = _hand(world), _place_behind(world)
    off = math.hypot(*(to - hand[:2]))
    height = world.robot.ee.lowest + LOW + FUNNEL.over(off)
    return _to(world, rise_first(hand, (*to, height)), _way(world)[0])


class Push(Task):
    """Push a puck to a goal. The goal is flat, and the puck is moved by contact alone."""

    name = "push"
    instruction = "Push the puck to the green goal."
    place = "the green goal"
    subtasks = MappingProxyType({"push": "push {it} to {place}"})
    horizon = 200
    objects = (PUCK,)
    sizes = (0.055, 0.07)
    rungs = (
        Rung("at_goal", lambda w: _way(w)[1] < AT_GOAL, lambda w: Target(*w.ee, _style(w).opening)),
        Rung("push", _pushes, _push),
        Rung("descend", lambda w: math.dist(_place_behind(w), _hand(w)[:2]) < NEAR, _around),
        Rung("approach", lambda w: True, _around),
    )

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the puck and the goal."""
        add_object(spec, PUCK, "cylinder", PUCK_SIZE, PUCK_MASS, RED)
        add_goal(spec, flat=True)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the puck, and a goal away from it.

        The hand can reach behind the puck.
        """
        at, height = draw_resting(rng, world, PUCK, ROOM + 0.02), resting_height(world, PUCK)

        def fits(goal: F64) -> bool:
            distance = math.hypot(*(goal - at)[:2])
            behind = at - ROOM / distance * (goal - at)
            return distance > FAR and world.reach.has(goal) and world.reach.has(behind)

        goal = draw_until(lambda: np.append(draw_xy(rng, world), height), fits, world, "the goal")
        return Start({PUCK: (at, UPRIGHT), GOAL: (np.append(goal[:2], 0.001), UPRIGHT)})

    def observe(self, world: World) -> Observed:
        """Return hand, goal and puck, and the vectors between them."""
        puck, goal = world.at(PUCK), world.goal
        return {
            **observe_hand(world),
            "goal": goal,
            PUCK: puck,
            "puck_from_ee": puck - world.ee.position,
            "goal_from_puck": goal - puck,
        }

    def error(self, world: World) -> float:
        """Return the distance of the puck from the goal on the table [m]."""
        return _way(world)[1]

    def progress(self, world: World) -> float:
        """Return progress by the distances left for hand and puck."""
        if self.error(world) < AT_GOAL or _pushes(world):
            return 0.5 + 0.5 * nearness(self.error(world))
        to = np.append(_place_behind(world), world.robot.ee.lowest + LOW)
        return 0.45 * nearness(math.dist(to, _hand(world)))
