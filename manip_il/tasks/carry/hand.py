"""Outlines of a hand that points down: what of it may meet a thing on the table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.robots.geometry import outline
from manip_il.sim.world import Scene
from manip_il.tasks.carry.layout import Layout, Part

F64 = NDArray[np.float64]
LEANING = 0.01  # how much farther a hand that leans reaches to all sides [m]
_ALIKE = 0.005  # radii of parts that count as one [m]
_BARELY = 0.004  # room that a hand keeps from a thing beside which it grasps [m]


class Box(NamedTuple):
    """Upright box around a part of the hand: its lowest point over `ee`, its middle (2,) and half lengths (2,) [m].

    Along the hand's own x and y, from `ee`.
    """

    bottom: float
    middle: F64
    half: F64


class Hand(NamedTuple):
    """The open hand, pointing down: parts as heights and radii about the vertical through `ee`, the same as boxes.

    home: where `ee` is at home, (3,) [m].
    """

    parts: tuple[Part, ...]
    boxes: tuple[Box, ...]
    home: F64


@lru_cache(8)
def hand_of(scene: Scene) -> Hand:
    """Return the hand of a scene's robot at home, (3,) [m]; computed once."""
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[scene.arm_q] = scene.robot.home
    data.qpos[scene.gripper.q] = scene.gripper.command(scene.gripper.most)
    mujoco.mj_kinematics(model, data)
    ee, moved = data.site_xpos[scene.ee_site], _last_bodies(scene)
    axes = data.site_xmat[scene.ee_site].reshape(3, 3)[:, :2]
    outlines = [
        outline(model, data, geom) - ee
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] in moved and (model.geom_contype[geom] or model.geom_conaffinity[geom])
    ]
    lean = LEANING if scene.robot.leans else 0.0
    return Hand(_parts(outlines, lean), tuple(_box(points, axes) for points in outlines), ee.copy())


def _parts(outlines: Sequence[F64], lean: float) -> tuple[Part, ...]:
    found = [(points[:, 2].min(), np.hypot(points[:, 0], points[:, 1]).max() + lean) for points in outlines]
    parts: list[Part] = []
    for bottom, radius in sorted(found):
        if not parts or radius > parts[-1].radius + _ALIKE:
            parts.append(Part(float(bottom), float(radius)))
        else:
            parts[-1] = parts[-1]._replace(radius=max(float(radius), parts[-1].radius))
    return tuple(parts)


def _box(points: F64, axes: F64) -> Box:
    flat = points @ axes
    low, high = flat.min(axis=0), flat.max(axis=0)
    return Box(float(points[:, 2].min()), (low + high) / 2, (high - low) / 2)


def fits(hand: Hand, at: F64, yaw: float, layout: Layout) -> bool:
    """Return whether a hand at a point (3,) [m], turned by a yaw [rad], is off the things of a layout."""
    axes = np.array([[math.cos(yaw), math.sin(yaw)], [math.sin(yaw), -math.cos(yaw)]])  # the hand's x and y
    for _, middle, half, height in layout.boxes:
        for box in hand.boxes:
            if at[2] + box.bottom > height + _BARELY:
                continue
            way = at[:2] + box.middle @ axes - middle
            turned = np.abs(axes)
            apart = np.abs(way) - half - box.half @ turned - _BARELY
            across = np.abs(axes @ way) - box.half - turned @ half - _BARELY
            if max(apart.max(), across.max()) < 0:
                return False
    return True


def _last_bodies(scene: Scene) -> set[int]:
    """Bodies that the arm's last two joints move."""
    model = scene.model
    first = int(model.jnt_bodyid[np.flatnonzero(model.jnt_qposadr == scene.arm_q[-2])[0]])
    found = {first}
    for body in range(first + 1, model.nbody):
        if int(model.body_parentid[body]) in found:
            found.add(body)
    return found
