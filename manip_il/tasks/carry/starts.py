"""Starts of `carry`: which things are present, and places that leave a path."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import Scene, World
from manip_il.tasks.carry.layout import THINGS, Layout
from manip_il.tasks.carry.things import EDGE, PARKED, Pose, hand_of, make_layout, scale_of
from manip_il.tasks.pick_place import OBJECT
from manip_il.tasks.starts import UPRIGHT

F64 = NDArray[np.float64]

SPARE = 0.008  # extra clearance at the start and at the goal [m]
GAP = 0.02  # least gap between two things, at full scale [m]
BETWEEN, OFF = 0.8, 0.05  # share of things between start and goal, and their standard deviation from that line [m]
FROM_EDGE = (0.045, 0.09)  # range of the table edge's distance from the nearer of start and goal [m]
TRIES = 40  # draws of a thing's place before the layout is drawn again
_SIDES = ((1.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # sides that the edge may be on: away from the robot, left, right


def draw_names(rng: np.random.Generator) -> list[str]:
    """Draw which one to four things are present, counting the table's edge."""
    names = rng.permutation([*THINGS, EDGE]).tolist()
    return names[: int(rng.integers(1, len(names) + 1))]


def draw_things(rng: np.random.Generator, world: World, here: Sequence[str], at: F64, goal: F64) -> dict[str, Pose]:
    """Draw the places of the things present, beside an object at (3,) with a goal (3,) [m].

    Return the poses of all things, empty if they do not fit.
    """
    scene, lengths = world.scene, world.extents(OBJECT)
    x, y = scene.robot.workspace.centre
    parked = np.array([x, y, -PARKED])
    poses: dict[str, Pose] = {name: (parked, UPRIGHT) for name in (*THINGS, EDGE)}
    edge = _draw_edge(rng, scene, at, goal) if EDGE in here else None
    if edge is not None:
        half = math.atan2(edge[1][1], edge[1][0]) / 2
        poses[EDGE] = edge[0], np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    places: dict[str, F64] = {}
    for name in (one for one in THINGS if one in here):
        nearest = x - scene.robot.workspace.half_width + scale_of(scene) * THINGS[name].half[0]  # towards the robot
        for _ in range(TRIES):
            place = _draw_place(rng, scene, at, goal)
            layout = make_layout(scene, lengths, goal, {**places, name: place}, edge)
            if place[0] > nearest and _fits(layout, hand_of(scene).home, at):
                places[name], poses[name] = place, (place, UPRIGHT)
                break
        else:
            return {}
    return poses


def _draw_edge(rng: np.random.Generator, scene: Scene, at: F64, goal: F64) -> tuple[F64, F64]:
    """Draw a point on the table's edge and the direction away from the table, (3,) each, clear of start and goal."""
    scale, middle = scale_of(scene), np.array([*scene.robot.workspace.centre, 0.0])
    outwards = np.array([*_SIDES[rng.integers(len(_SIDES))], 0.0])
    farthest = max(float((one - middle) @ outwards) for one in (at, goal))
    return middle + outwards * (max(farthest, 0.0) + scale * rng.uniform(*FROM_EDGE)), outwards


def _draw_place(rng: np.random.Generator, scene: Scene, at: F64, goal: F64) -> F64:
    """Draw a place on the table, mostly between start and goal, (3,) [m]."""
    space, scale = scene.robot.workspace, scale_of(scene)
    if rng.uniform() > BETWEEN:
        x, y = np.array(space.centre) + rng.uniform(-1.4, 1.4, 2) * space.half_width
        return np.array([x, y, 0.0])
    way, share = (goal - at)[:2], rng.uniform(0.25, 0.75)
    across = np.array([-way[1], way[0]]) / max(np.linalg.norm(way), 1e-9)
    x, y = at[:2] + share * way + across * rng.normal(0.0, OFF * scale)
    return np.array([x, y, 0.0])


def _fits(layout: Layout, home: F64, at: F64) -> bool:
    """Whether the last thing leaves room at the start, the goal and the hand's home, and to others and the edge."""
    ends = np.array([at, layout.goal, [*home[:2], max(home[2], layout.half)]])
    if layout.room(ends).min() < SPARE:
        return False
    *others, (name, place) = [(one, np.array(where)) for one, where in layout.places]
    half = layout.scale * np.array(THINGS[name].half)
    for other, where in others:
        apart = np.abs(place - where) - half - layout.scale * np.array(THINGS[other].half)
        if apart.max() < GAP * layout.scale:
            return False
    edge = layout.edge
    return edge is None or bool((np.array(edge.at) - place) @ np.array(edge.outwards) > half.max())
