"""Bodies of `carry`'s obstacles, a world's layout and reward, and the parts of a hand that may
hit an obstacle.
"""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import outline
from manip_il.sim.scene import SCENES_KEPT
from manip_il.sim.world import Scene, World
from manip_il.tasks.carry.layout import (
    DEFAULT,
    FEATURES,
    FULL,
    OBSTACLES,
    TASTES,
    Edge,
    Layout,
    Part,
    Reward,
)
from manip_il.tasks.grasp import once_per_state
from manip_il.tasks.objects import add_furniture, add_part
from manip_il.tasks.pick_place import OBJECT

EDGE = "edge"  # the mocap body of the table's edge; its x points away from the table
# mocap bodies that hold the weights
TASTE_BODIES = tuple(f"taste_{number}" for number in range(len(FEATURES) // 3))
LEANING = 0.01  # extra radius of a leaning hand [m]
_ALIKE = 0.005  # difference of radii up to which parts count as one [m]
_BARELY = 0.004  # clearance of a grasping hand from an obstacle beside it [m]
PARKED = 0.25  # depth of absent obstacles below the table's top [m]
_PLATE = (0.15, 0.36, 0.0005)  # half lengths of the visual plate beyond the edge [m]
_DARK = (0.16, 0.17, 0.20)
_LID = (0.62, 0.64, 0.68)
_KEYS = (0.20, 0.21, 0.24)
_CLAY = (0.20, 0.45, 0.52)
_WAX = (0.96, 0.93, 0.84)
_FLAME = (1.0, 0.62, 0.15)
_LOOKS = {  # visual geoms: kind, half size and middle in shares of the obstacle's box, colour
    "vase": (
        ("CYLINDER", (0.60, 0.05), 0.05, _CLAY),
        ("ELLIPSOID", (1.0, 0.36), 0.42, _CLAY),
        ("CYLINDER", (0.45, 0.15), 0.85, _CLAY),
        ("CYLINDER", (0.70, 0.02), 0.98, _CLAY),
    ),
    "laptop": (("BOX", (1.0, 0.5), 0.5, _LID), ("BOX", (0.85, 0.01), 1.0, _KEYS)),
    "candle": (("CYLINDER", (1.0, 0.42), 0.42, _WAX), ("ELLIPSOID", (0.45, 0.08), 0.92, _FLAME)),
}


def add_obstacles(spec: mujoco.MjSpec, scale: float) -> None:
    """Add the obstacles and the table's edge, with all that they need.

    The obstacles have contact boxes. The positions of further bodies hold the reward's weights.
    """
    for name, obstacle in OBSTACLES.items():
        body = add_furniture(spec, name)
        body.pos = [0.5, 0, -PARKED]
        half = scale * np.array([*obstacle.half, obstacle.height / 2])
        add_part(body, name, half.tolist(), (0, 0, half[2]), _LID)
        body.first_geom().rgba = [0, 0, 0, 0]  # invisible: the visual geoms lie within it
        for kind, (wide, tall), middle, colour in _LOOKS[name]:
            size = half * [wide, wide, 2 * tall]
            _add_look(
                body,
                kind,
                size if kind != "CYLINDER" else size[[0, 2, 2]],
                middle * 2 * half[2],
                colour,
            )
    edge = add_furniture(spec, EDGE)
    edge.pos = [0.5, 0, -PARKED]
    plate = scale * np.array(_PLATE)
    _add_look(edge, "BOX", plate, 0.0, _DARK, ahead=float(plate[0]))
    for name, weights in zip(
        TASTE_BODIES, np.reshape(TASTES[DEFAULT].weights, (-1, 3)), strict=True
    ):
        add_furniture(spec, name).pos = weights


def _add_look(
    body: object, kind: str, size: F64, up: float, colour: Sequence[float], ahead: float = 0.0
) -> None:
    body.add_geom(  # pyright: ignore[reportAttributeAccessIssue]
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"),
        size=size.tolist(),
        pos=[ahead, 0, up],
        rgba=[*colour, 1],
        contype=0,
        conaffinity=0,
        mass=0,
    )


def scale_of(scene: Scene) -> float:
    """Return the scale of the obstacles for an arm: its workspace's half width over `FULL`."""
    return scene.robot.workspace.half_width / FULL


@once_per_state
def reward_in(world: World) -> Reward:
    """Return the reward of an episode."""
    return Reward(tuple(number for name in TASTE_BODIES for number in world.at(name).tolist()))


def is_there(world: World, name: str) -> bool:
    """Return whether an obstacle, or the table's edge, is part of an episode."""
    return bool(world.at(name)[2] > -PARKED / 2)


@once_per_state
def layout_of(world: World) -> Layout:
    """Return the layout of an episode."""
    places = {obstacle: world.at(obstacle) for obstacle in OBSTACLES if is_there(world, obstacle)}
    edge, turn = world.pose(EDGE)
    seen = (edge, turn[:, 0]) if is_there(world, EDGE) else None
    return make_layout(world.scene, world.extents(OBJECT), world.goal, places, seen)


def make_layout(
    scene: Scene,
    lengths: Sequence[float],
    goal: F64,
    places: Mapping[str, F64],
    edge: tuple[F64, F64] | None,
) -> Layout:
    """Return the layout for an object, its goal, and what stands on the table.

    Args:
        scene: The scene, whose robot gives the obstacles' scale and the parts of the hand.
        lengths: The object's lengths along its axes, (3,) [m].
        goal: The target of the object's centre, (3,) [m].
        places: The positions of the obstacles that are present, (3,) [m] each, by name.
        edge: A point on the table's edge, (3,) [m], and the direction away from the table, (3,);
            None if the edge is not near.
    """
    _, middle, longest = sorted(lengths)
    own = Part(-longest / 2, math.hypot(middle, longest) / 2)
    return Layout(
        scale=scale_of(scene),
        goal=tuple(goal.tolist()),
        places=tuple(
            (name, tuple(places[name][:2].tolist())) for name in OBSTACLES if name in places
        ),
        edge=edge and Edge(*(tuple(vector[:2].tolist()) for vector in edge)),
        half=longest / 2,
        parts=(own, *hand_of(scene).parts),
    )


def observed_layout(scene: Scene, seen: Mapping[str, float]) -> Layout:
    """Return the layout that the numbers of `environment_state`, by name, describe."""

    def vector(of: str) -> F64:
        return np.array([seen[f"{of}.{axis}"] for axis in "xyz"], dtype=np.float64)

    width = seen[f"{OBJECT}.width"]
    lengths = [seen.get(f"{OBJECT}.{which}", width) for which in ("width", "length", "height")]
    places = {one: vector(one) for one in OBSTACLES if seen[f"{one}.here"] > 0.5}
    edge = (vector(EDGE), vector(f"{EDGE}.outwards")) if seen[f"{EDGE}.here"] > 0.5 else None
    return make_layout(scene, lengths, vector("goal"), places, edge)


def observe_obstacles(world: World) -> dict[str, F64 | float]:
    """Return the position [m] and presence of every obstacle and of the table's edge.

    The edge's position is a point on it; its outward axis is returned as well.
    """
    found: dict[str, F64 | float] = {}
    for name in (*OBSTACLES, EDGE):
        found |= {name: world.at(name), f"{name}.here": float(is_there(world, name))}
    return found | {f"{EDGE}.outwards": world.pose(EDGE).rotation[:, 0]}


class Box(NamedTuple):
    """Upright box around a part of the hand, relative to `ee`.

    Attributes:
        bottom: The height of its lowest point [m].
        middle: Its centre along the hand's x and y, (2,) [m].
        half: Half its lengths along the hand's x and y, (2,) [m].
    """

    bottom: float
    middle: F64
    half: F64


class HandShape(NamedTuple):
    """The open hand that points down.

    Attributes:
        parts: The lowest points and radii of its parts about the vertical through `ee`.
        boxes: A box around each geom.
        home: The position of `ee` in the arm's home pose, (3,) [m].
    """

    parts: tuple[Part, ...]
    boxes: tuple[Box, ...]
    home: F64


@lru_cache(SCENES_KEPT)
def hand_of(scene: Scene) -> HandShape:
    """Return the shape of the hand of a scene's robot, in its home pose; cached."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[scene.arm_q] = scene.robot.home
    scene.gripper.put(data, scene.gripper.most)
    mujoco.mj_kinematics(model, data)
    # what the arm's last two joints move
    [first] = model.jnt_bodyid[model.jnt_qposadr == scene.arm_q[-2]].tolist()
    moved = {first}
    for body in range(first + 1, model.nbody):
        if int(model.body_parentid[body]) in moved:
            moved.add(body)
    ee = data.site_xpos[scene.ee_site]
    axes = data.site_xmat[scene.ee_site].reshape(3, 3)[:, :2]
    outlines = [
        outline(model, data, geom) - ee
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] in moved
        and (model.geom_contype[geom] or model.geom_conaffinity[geom])
    ]
    parts = _parts(outlines, LEANING if scene.robot.leans else 0.0)
    return HandShape(parts, tuple(_box(points, axes) for points in outlines), ee.copy())


def _parts(outlines: Sequence[F64], lean: float) -> tuple[Part, ...]:
    parts: list[Part] = []
    found = (
        (float(z.min()), float(np.hypot(x, y).max()) + lean)
        for x, y, z in map(np.transpose, outlines)
    )
    for bottom, radius in sorted(found):
        if not parts or radius > parts[-1].radius + _ALIKE:
            parts.append(Part(bottom, radius))
        else:
            parts[-1] = Part(parts[-1].bottom, max(radius, parts[-1].radius))
    return tuple(parts)


def _box(points: F64, axes: F64) -> Box:
    flat = points @ axes
    low, high = flat.min(axis=0), flat.max(axis=0)
    return Box(float(points[:, 2].min()), (low + high) / 2, (high - low) / 2)


def fits(hand: HandShape, at: Sequence[float], yaw: float, layout: Layout) -> bool:
    """Return whether a downward hand is clear of all obstacles.

    Args:
        hand: The shape of the hand.
        at: The position of `ee`, (3,) [m].
        yaw: The yaw of the hand [rad].
        layout: The layout, of which only the obstacles count.
    """
    # the hand's x and y
    axes = np.array([[math.cos(yaw), math.sin(yaw)], [math.sin(yaw), -math.cos(yaw)]])
    for _, middle, half, height in layout.boxes:
        for box in hand.boxes:
            if at[2] + box.bottom > height + _BARELY:
                continue
            way = at[:2] + box.middle @ axes - middle
            apart = np.abs(way) - half - box.half @ np.abs(axes)
            across = np.abs(axes @ way) - box.half - np.abs(axes) @ half
            if max(apart.max(), across.max()) < _BARELY:
                return False
    return True
