"""Things of `carry` as bodies: how a scene gets them, the layout that a world has, and where starts put them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import MismatchError
from manip_il.robots.geometry import outline
from manip_il.robots.reach import reach_of
from manip_il.robots.robot import Robot
from manip_il.sim.world import Scene, World
from manip_il.tasks.grid import Space
from manip_il.tasks.layout import FULL, THINGS, Edge, Layout, Part
from manip_il.tasks.objects import add_furniture, add_part
from manip_il.tasks.pick_place import OBJECT
from manip_il.tasks.reward import DEFAULT, FEATURES, TASTES, Reward
from manip_il.tasks.starts import UPRIGHT

F64 = NDArray[np.float64]
Pose = tuple[F64, F64]  # position (3,) [m], quaternion wxyz (4,)

EDGE = "edge"  # the mocap body of the table's edge; its x points away from the table
TASTES_OF = tuple(f"taste_{number}" for number in range(len(FEATURES) // 3))  # mocap bodies that hold the weights
PARKED = 0.25  # of what is not there, under the table's top [m]
LEANING = 0.01  # how much farther a hand that leans reaches to all sides [m]
_ALIKE = 0.005  # radii of parts that count as one [m]
_PLATE = (0.15, 0.36, 0.0005)  # half of what lies beyond the edge, which is only seen [m]
_DARK, _LID, _KEYS = (0.16, 0.17, 0.20), (0.62, 0.64, 0.68), (0.20, 0.21, 0.24)
_CLAY, _WAX, _FLAME = (0.20, 0.45, 0.52), (0.96, 0.93, 0.84), (1.0, 0.62, 0.15)
_LOOKS = {  # of a thing: kind, half its size, its middle, in shares of the thing's box; colour
    "vase": (
        ("CYLINDER", (0.60, 0.05), 0.05, _CLAY),
        ("ELLIPSOID", (1.0, 0.36), 0.42, _CLAY),
        ("CYLINDER", (0.45, 0.15), 0.85, _CLAY),
        ("CYLINDER", (0.70, 0.02), 0.98, _CLAY),
    ),
    "laptop": (("BOX", (1.0, 0.5), 0.5, _LID), ("BOX", (0.85, 0.01), 1.0, _KEYS)),
    "candle": (("CYLINDER", (1.0, 0.42), 0.42, _WAX), ("ELLIPSOID", (0.45, 0.08), 0.92, _FLAME)),
}


def add_things(spec: mujoco.MjSpec, scale: float) -> None:
    """Add every thing, solid as its box, the table's edge, and what holds the weights of the reward."""
    for name, thing in THINGS.items():
        body = add_furniture(spec, name)
        body.pos = [0.5, 0, -PARKED]
        half = scale * np.array([*thing.half, thing.height / 2])
        add_part(body, name, half.tolist(), (0, 0, half[2]), _LID)
        body.first_geom().rgba = [0, 0, 0, 0]  # what is seen of it lies within
        for kind, (wide, tall), middle, colour in _LOOKS[name]:
            size = half * [wide, wide, 2 * tall]
            _add_look(body, kind, size if kind != "CYLINDER" else size[[0, 2, 2]], middle * 2 * half[2], colour)
    edge = add_furniture(spec, EDGE)
    edge.pos = [0.5, 0, -PARKED]
    plate = scale * np.array(_PLATE)
    _add_look(edge, "BOX", plate, 0.0, _DARK, ahead=float(plate[0]))
    for name, weights in zip(TASTES_OF, np.reshape(TASTES[DEFAULT].weights, (-1, 3)), strict=True):
        add_furniture(spec, name).pos = weights


def _add_look(body: object, kind: str, size: F64, up: float, colour: Sequence[float], ahead: float = 0.0) -> None:
    body.add_geom(  # pyright: ignore[reportAttributeAccessIssue]
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"),
        size=size.tolist(),
        pos=[ahead, 0, up],
        rgba=[*colour, 1],
        contype=0,
        conaffinity=0,
        mass=0,
    )


class Hand(NamedTuple):
    """Parts of the open hand, as they hang on `ee`, and where that is at home, (3,) [m]."""

    parts: tuple[Part, ...]
    home: F64


@lru_cache(8)
def hand_of(scene: Scene) -> Hand:
    """Return the hand's parts as heights and radii about the vertical through `ee` at home, and its place (3,) [m]."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[scene.arm_q] = scene.robot.home
    data.qpos[scene.gripper.q] = scene.gripper.command(scene.gripper.most)
    mujoco.mj_kinematics(model, data)
    ee, moved = data.site_xpos[scene.ee_site], _last_bodies(scene)
    found = []
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] in moved and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            points = outline(model, data, geom) - ee
            found.append((float(points[:, 2].min()), float(np.hypot(points[:, 0], points[:, 1]).max())))
    lean = LEANING if scene.robot.leans else 0.0
    parts: list[Part] = []
    for bottom, radius in sorted(found):
        if not parts or radius + lean > parts[-1].radius + _ALIKE:
            parts.append(Part(bottom, radius + lean))
        else:
            parts[-1] = Part(parts[-1].bottom, max(radius + lean, parts[-1].radius))
    return Hand(tuple(parts), ee.copy())


def _last_bodies(scene: Scene) -> set[int]:
    """Bodies that the arm's last two joints move."""
    model = scene.model
    first = int(model.jnt_bodyid[np.flatnonzero(model.jnt_qposadr == scene.arm_q[-2])[0]])
    found = {first}
    for body in range(first + 1, model.nbody):
        if int(model.body_parentid[body]) in found:
            found.add(body)
    return found


@cache
def space_of(robot: Robot) -> Space:
    """Return a robot's workspace, and where its hand gets to."""
    reach, space = reach_of(robot), robot.workspace
    origin = tuple(reach.origin.tolist())
    return Space((space.centre[0], space.centre[1]), space.half_width, origin, reach.cell, reach.arrives)


def scale_of(scene: Scene) -> float:
    """Return the scale of the things for an arm: its workspace's width in that of `FULL`."""
    return scene.robot.workspace.half_width / FULL


def reward_in(world: World) -> Reward:
    """Return the reward that an episode is about."""
    return world.remember("reward", lambda: _reward(world))


def _reward(world: World) -> Reward:
    return Reward(tuple(number for name in TASTES_OF for number in world.pose(name).position.tolist()))


def is_there(world: World, name: str) -> bool:
    """Return whether a thing, or the table's edge, is part of an episode."""
    return bool(world.pose(name).position[2] > -PARKED / 2)


def layout_of(world: World, name: str) -> Layout:
    """Return the layout of an episode in which an object is carried to the goal; computed once a state."""
    return world.remember(("layout", name), lambda: _layout(world, name))


def _layout(world: World, name: str) -> Layout:
    places = {thing: world.pose(thing).position for thing in THINGS if is_there(world, thing)}
    edge, turn = world.pose(EDGE)
    seen = (edge, turn[:, 0]) if is_there(world, EDGE) else None
    return make_layout(world.scene, world.extents(name), world.goal, places, seen)


def make_layout(
    scene: Scene, lengths: Sequence[float], goal: F64, places: Mapping[str, F64], edge: tuple[F64, F64] | None
) -> Layout:
    """Return the layout of an object of lengths (3,) [m], a goal (3,) [m], places of things (3,) [m], and an edge.

    edge: a point on it (3,) [m] and the direction away from the table, (3,).
    """
    _, middle, longest = sorted(lengths)
    own = Part(-longest / 2, math.hypot(middle, longest) / 2)
    return Layout(
        scale=scale_of(scene),
        goal=_numbers(goal),
        places=tuple((name, _numbers(places[name])[:2]) for name in THINGS if name in places),
        edge=None if edge is None else Edge(_numbers(edge[0])[:2], _numbers(edge[1])[:2]),
        half=longest / 2,
        parts=(own, *hand_of(scene).parts),
    )


def _numbers(vector: F64) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def observed_layout(scene: Scene, name: str, seen: Mapping[str, float]) -> Layout:
    """Return the layout of an episode with an object by that name, as `environment_state` shows it.

    seen: numbers by name. Raises `MismatchError` where one that it takes is missing.
    """

    def vector(of: str) -> F64:
        return np.array([number(f"{of}.{axis}") for axis in "xyz"])

    def number(of: str) -> float:
        if of not in seen:
            raise MismatchError("names of environment_state", "a dataset", f"no {of}", "carry", of)
        return float(seen[of])

    width = number(f"{name}.width")
    lengths = [width, seen.get(f"{name}.length", width), seen.get(f"{name}.height", width)]
    places = {thing: vector(thing) for thing in THINGS if number(f"{thing}.here") > 0.5}
    edge = (vector(EDGE), vector(f"{EDGE}.outwards")) if number(f"{EDGE}.here") > 0.5 else None
    return make_layout(scene, lengths, vector("goal"), places, edge)


def observe_things(world: World) -> dict[str, F64 | float]:
    """Return where every thing is [m] and whether it is there, and the table's edge: a point on it, its direction."""
    found: dict[str, F64 | float] = {}
    for name in (*THINGS, EDGE):
        found |= {name: world.pose(name).position, f"{name}.here": float(is_there(world, name))}
    return {**found, f"{EDGE}.outwards": world.pose(EDGE).rotation[:, 0]}


# Starts

SPARE = 0.008  # room beyond what is kept anyway, at the start and at the goal [m]
GAP = 0.02  # between two things, at full scale [m]
BETWEEN, OFF = 0.8, 0.05  # share of things that stand between start and goal, and how far off that line, as a deviation
FROM_EDGE = (0.045, 0.09)  # of start and goal from the table's edge, at least, and of the nearer one at most [m]
TRIES = 40  # of a thing's place, before the layout is drawn anew
_SIDES = ((1.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # of the table where its edge may be: away from the robot, left, right


def draw_names(rng: np.random.Generator) -> list[str]:
    """Draw which one to four of the things there are, the table's edge among them."""
    names = rng.permutation([*THINGS, EDGE]).tolist()
    return names[: int(rng.integers(1, len(names) + 1))]


def draw_things(rng: np.random.Generator, world: World, here: Sequence[str], at: F64, goal: F64) -> dict[str, Pose]:
    """Draw where the things stand that are there, beside an object at (3,) with a goal (3,) [m].

    Return poses of all things, empty where they do not fit.
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
        nearest = x - scene.robot.workspace.half_width + scale_of(scene) * THINGS[name].half[0]  # to the robot
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
    """Draw a point on the table's edge and the direction away from the table, (3,) each, off start and goal."""
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
    """Whether the last thing leaves room at the start, at the goal and to the hand at home, to others and the edge."""
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
