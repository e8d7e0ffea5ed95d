"""Carry: move the object to the goal past obstacles on the table, on the cheapest path for a
reward.

The path is planned for the object's centre, on a grid over the free space of the episode's layout.
The reward's weights are part of the state, as positions of invisible mocap bodies, so that a label
is a function of the state.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import mujoco
import numpy as np

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.option import NameOrPath
from manip_il.robots.geometry import hand_down
from manip_il.robots.robot import Robot
from manip_il.sim.shape import CUBE, ObjectShape
from manip_il.sim.task import Observed, Rung, Start, Target
from manip_il.sim.world import GOAL, Scene, World
from manip_il.tasks.carry.grid import Descent, descent
from manip_il.tasks.carry.layout import (
    ABOVE,
    ASIDE,
    DEFAULT,
    FULL,
    OBSTACLES,
    TASTES,
    Layout,
    Reward,
)
from manip_il.tasks.carry.obstacles import (
    EDGE,
    PARKED,
    TASTE_BODIES,
    add_obstacles,
    fits,
    hand_of,
    layout_of,
    make_layout,
    observe_obstacles,
    reward_in,
    scale_of,
)
from manip_il.tasks.grasp import grasp_of, once_per_state
from manip_il.tasks.ladder import (
    AT_GOAL,
    CLOSED,
    approach,
    grasp_progress,
    grasp_rungs,
    is_held,
    nearness,
)
from manip_il.tasks.objects import IN_AIR, UPRIGHT, draw_lying, draw_xy, turn_left
from manip_il.tasks.pick_place import OBJECT, PickPlace

NAME = "carry"
APART = 0.22  # least sideways distance of the goal from the object at the start, at full scale [m]
HIGHEST = 0.2  # greatest height of a goal over the object's resting height, at full scale [m]
STEP = 0.05  # how far ahead of the hand its target runs while it carries [m]
# misalignment up to which an empty hand may be down beside obstacles [m]; slope beyond
OVER, STEEP = 0.012, 8.0
# draws of a start, and draws after which one more obstacle is left out
_DRAWS, _TOO_MANY = 4_000, 80
_GRASPED = 0.5  # progress of an object that is held
SPARE = 0.008  # extra clearance at the start and at the goal [m]
GAP = 0.02  # least gap between two obstacles, at full scale [m]
# share of obstacles near the line from start to goal; standard deviation from it [m]
BETWEEN, OFF = 0.8, 0.05
# range of distances from the table's edge to the nearer of start and goal [m]
FROM_EDGE = (0.045, 0.09)
TRIES = 40  # draws of an obstacle's place before the layout is drawn again
# sides that the edge may be on: away from the robot, left, right
_SIDES = ((1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


def descent_of(world: World) -> Descent:
    """Return the costs-to-go of a world's episode, as a `Descent` to the goal."""
    return descent(layout_of(world), reward_in(world), world.robot)


@once_per_state
def _look(world: World) -> tuple[float, F64 | None]:
    """Cost-to-go at the object's position, and the point to head for."""
    return descent_of(world).look(world.at(OBJECT))


def _at_goal(world: World) -> bool:
    return math.dist(world.at(OBJECT), world.goal) < AT_GOAL


def _to_goal(world: World) -> Target:
    """Carry the object down the costs-to-go; stay if there is no path."""
    heading = world.goal if _at_goal(world) else _look(world)[1]
    at, ee = world.at(OBJECT), world.ee.position
    position = ee + (0.0 if heading is None else heading - at)
    position[2] = max(position[2], world.robot.ee.lowest)
    beside = layout_of(world).room(at[None])[0] < 0  # a turning hand would hit an obstacle
    yaw = world.hand_yaw if beside else world.ahead(position)
    return Target(position, hand_down(yaw), CLOSED, max_step=STEP)


def _rise(world: World) -> float:
    """Least height of the hand over the grasp [m].

    It grows with misalignment until the hand clears every obstacle.
    """
    layout, g = layout_of(world), grasp_of(world, OBJECT)
    if not layout.boxes:
        return 0.0
    tallest = max(height for _, _, _, height in layout.boxes)
    # height at which an open hand clears all
    safe = tallest + ABOVE - min(part.bottom for part in layout.parts[1:])
    return min(STEEP * max(0.0, g.off - OVER), max(0.0, safe - g.at[2]))


@dataclass(frozen=True)
class Carry(PickPlace):
    """Carry an object past obstacles to the goal, as cheaply as possible for a reward.

    Attributes:
        reward: What a metre of path costs. It is written into the state at every start, and the
            expert reads it from there.
        scale: The scale of the obstacles, see `Layout`.
    """

    name: str = NAME
    instruction: str = "Carry the cube past what stands on the table to the green goal."
    horizon: int = 200
    argument_bodies = TASTE_BODIES
    rungs = (
        Rung("at_goal", lambda w: is_held(w, OBJECT) and _at_goal(w), _to_goal),
        Rung("carry", lambda w: is_held(w, OBJECT), _to_goal),
        # above all obstacles until the hand is over the object
        *grasp_rungs(
            lambda w: OBJECT, approach=lambda w, name, hover: approach(w, name, hover, _rise(w))
        ),
    )
    scale: float = 1.0
    reward: Reward = TASTES[DEFAULT]

    def with_shape(self, shape: ObjectShape) -> Self:
        """Return the task with another object."""
        return replace(super().with_shape(shape), horizon=200 if shape == CUBE else 300)

    def with_argument(self, text: NameOrPath) -> Self:
        """Return the task with the reward that a text or a file describes.

        Its name lists the nonzero weights.
        """
        reward = Reward.parse(text)
        return replace(
            self,
            name=NAME if reward == TASTES[DEFAULT] else f"{NAME}:{reward.numbers}",
            reward=reward,
        )

    def fitted(self, robot: Robot) -> Self:
        """Return the task with obstacles scaled to a robot's workspace."""
        return replace(self, scale=robot.workspace.half_width / FULL)

    def build(self, spec: mujoco.MjSpec) -> None:
        """Add the object and the goal, the obstacles, and the bodies that hold the reward."""
        super().build(spec)
        add_obstacles(spec, self.scale)

    def draw(self, rng: np.random.Generator, world: World) -> Start:
        """Draw the object, the goal and one to four obstacles, mostly between object and goal.

        Store the reward.
        """
        names = rng.permutation([*OBSTACLES, EDGE]).tolist()
        names = names[: int(rng.integers(1, len(names) + 1))]
        for tried in range(_DRAWS):
            at, turn = draw_lying(rng, world, OBJECT)
            goal = _draw_goal(rng, world, at)
            if not _has_way(world, at, goal):
                continue
            fewer = names[: max(1, len(names) - tried // _TOO_MANY)]
            if obstacles := _draw_obstacles(rng, world, fewer, at, goal):
                weights = zip(TASTE_BODIES, np.reshape(self.reward.weights, (-1, 3)), strict=True)
                tastes = {name: (three, UPRIGHT) for name, three in weights}
                return Start({OBJECT: (at, turn), GOAL: (goal, UPRIGHT), **obstacles, **tastes})
        raise UsageError(
            f"task {self.name}: none of {_DRAWS:,} layouts drawn fits within reach of"
            f" {world.robot.name}; choose another task or robot"
        )

    def observe(self, world: World) -> Observed:
        """Return what `pick_place` observes, and all obstacles, but not the reward.

        Of each obstacle it returns the position, and whether it is present.
        """
        return {**super().observe(world), **observe_obstacles(world)}

    def unsound(self, world: World) -> str:
        """Return why there is no sound label, or "" if there is one.

        There is none if the hand has no room, or no path leads to the goal.
        """
        layout, at = layout_of(world), world.at(OBJECT)
        if is_held(world, OBJECT):
            leads = _at_goal(world) or _look(world)[1] is not None
        else:
            g, leads = grasp_of(world, OBJECT), descent_of(world).leads(at)
            if layout.room(at[None])[0] < -ASIDE and not fits(
                hand_of(world.scene), g.at, g.yaw, layout
            ):
                return "no room for the hand beside an obstacle"
        return "" if leads else "no free path to the goal"

    def progress(self, world: World) -> float:
        """Return progress by the distance to the grasp, then by the cost-to-go.

        The cost-to-go is divided by the cost of a metre at the goal.
        """
        if not is_held(world, OBJECT):
            return 0.9 * _GRASPED * grasp_progress(world, OBJECT, rise=_rise(world))
        if _at_goal(world):
            return 1.0
        down = descent_of(world)
        price = float((down.grid.layout.densities(world.goal[None]) @ down.weights)[0])
        cost = _look(world)[0] / price
        return _GRASPED + (1 - _GRASPED) * nearness(cost) if math.isfinite(cost) else _GRASPED


def _draw_goal(rng: np.random.Generator, world: World, at: F64) -> F64:
    """Draw a goal, half of the time on the table, (3,) [m]."""
    xy = draw_xy(rng, world)
    up = rng.uniform(0, HIGHEST * scale_of(world.scene)) if rng.uniform() < IN_AIR else 0.0
    return np.append(xy, at[2] + up)


def _has_way(world: World, at: F64, goal: F64) -> bool:
    """Whether a goal is far enough from the object, and the hand can carry the object there over
    any obstacles.
    """
    scale = scale_of(world.scene)
    if math.dist(at[:2], goal[:2]) < APART * scale or not world.reach.has(goal):
        return False
    height = (
        scale * max(one.height for one in OBSTACLES.values())
        + max(world.extents(OBJECT)) / 2
        + 2 * ABOVE
    )
    over = [np.append(place[:2], max(height, goal[2])) for place in (at, goal)]
    lines = [np.linspace(start, end, 12) for start, end in pairwise((at, *over, goal))]
    return bool(world.reach.has_each(np.concatenate(lines, dtype=np.float64)).all())


def _draw_obstacles(
    rng: np.random.Generator, world: World, here: Sequence[str], at: F64, goal: F64
) -> dict[str, tuple[F64, F64]]:
    """Draw the places of the obstacles in `here`, clear of the object's place `at` (3,) and its
    goal (3,) [m].

    Return the poses of all obstacles and the edge, or an empty dict if they do not fit.
    """
    scene, lengths = world.scene, world.extents(OBJECT)
    x, y = scene.robot.workspace.centre
    parked = np.array([x, y, -PARKED])
    poses = {name: (parked, UPRIGHT) for name in (*OBSTACLES, EDGE)}
    edge = _draw_edge(rng, scene, at, goal) if EDGE in here else None
    if edge is not None:
        poses[EDGE] = edge[0], turn_left(math.atan2(edge[1][1], edge[1][0]))
    places: dict[str, F64] = {}
    for name in (name for name in OBSTACLES if name in here):
        # towards the robot
        nearest = x - scene.robot.workspace.half_width + scale_of(scene) * OBSTACLES[name].half[0]
        for _ in range(TRIES):
            places[name] = _draw_place(rng, scene, at, goal)
            layout = make_layout(scene, lengths, goal, places, edge)
            if places[name][0] > nearest and _leaves_room(layout, hand_of(scene).home, at):
                break
        else:
            return {}
    return poses | {name: (place, UPRIGHT) for name, place in places.items()}


def _draw_edge(rng: np.random.Generator, scene: Scene, at: F64, goal: F64) -> tuple[F64, F64]:
    """Draw a point on the table's edge and the direction away from the table, (3,) each, clear
    of start and goal.
    """
    scale, middle = scale_of(scene), np.array([*scene.robot.workspace.centre, 0.0])
    outwards = np.array([*_SIDES[rng.integers(len(_SIDES))], 0.0])
    farthest = max(float((one - middle) @ outwards) for one in (at, goal))
    return middle + outwards * (max(farthest, 0.0) + scale * rng.uniform(*FROM_EDGE)), outwards


def _draw_place(rng: np.random.Generator, scene: Scene, at: F64, goal: F64) -> F64:
    """Draw a place on the table, mostly between start and goal, (3,) [m]."""
    space, scale = scene.robot.workspace, scale_of(scene)
    if rng.uniform() > BETWEEN:
        return np.append(np.array(space.centre) + rng.uniform(-1.4, 1.4, 2) * space.half_width, 0.0)
    way, share = (goal - at)[:2], rng.uniform(0.25, 0.75)
    across = np.array([-way[1], way[0]]) / max(np.linalg.norm(way), 1e-9)
    return np.append(at[:2] + share * way + across * rng.normal(0.0, OFF * scale), 0.0)


def _leaves_room(layout: Layout, home: F64, at: F64) -> bool:
    """Whether the last obstacle is clear of start, goal and the hand's home, of other obstacles,
    and of the edge.
    """
    ends = np.array([at, layout.goal, [*home[:2], max(home[2], layout.half)]])
    if layout.room(ends).min() < SPARE:
        return False
    *others, (_, place, half, _) = layout.boxes
    gaps = [(np.abs(place - other) - half - its).max() for _, other, its, _ in others]
    if min(gaps, default=np.inf) < GAP * layout.scale:
        return False
    edge = layout.edge
    return edge is None or bool((np.array(edge.at) - place) @ np.array(edge.outwards) > half.max())
