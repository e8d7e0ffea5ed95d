"""What is read of one state of two arms: hands, objects, and what touches what."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.robots.rotations import angle_between
from manip_il.tasks.stock.table import SIDES, AlohaTask, Held

F64 = NDArray[np.float64]

FINGER_AT_TOUCH = 0.0224  # joint of a finger at which the two would touch each other [m]
GRASP_AHEAD = -0.002  # where the hand holds an object, along its fingers from its site [m]
AROUND = (0.010, 0.012, 0.010)  # off that place at most when the fingers begin to close, in the hand's axes [m]
HELD_AROUND = (0.020, 0.022, 0.020)  # and while they close or hold [m]
ANGLE, HELD_ANGLE = 0.25, 0.6  # off the grasp's rotation at most, then and then [rad]
LIFTED = 0.04  # height of an object that has left the table [m]
SLACK = 0.004  # half the gap beyond `Held.open` at which fingers still get hold of what is between them, in the air [m]
X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Hand:
    """One hand: where it is (3,) [m], its axes (ahead, across the fingers, up) (3, 3), half the gap of its fingers [m].

    q: joints of its arm, (6,) [rad]. outward: the way that its fingers open when it reaches for the table's middle.
    """

    side: str
    position: F64
    rotation: F64
    gap: float
    q: F64
    outward: F64

    def sees(self, point: F64) -> F64:
        """Return a point (3,) in the hand's axes, from the hand [m]."""
        return self.rotation.T @ (point - self.position)


@dataclass(frozen=True)
class Thing:
    """One object: its middle (3,) [m] and its axes (3, 3), and what is known of it."""

    position: F64
    axes: F64
    about: Held

    @cached_property
    def frame(self) -> F64:
        """Axes, its own long one first, with the order and signs nearest to the world's, (3, 3).

        It looks the same turned into any of them.
        """
        if self.about.long:
            ahead = nearest(self.axes[:, :1], X)
            up = nearest(self.axes[:, 1:], Z)
        else:
            up = nearest(self.axes, Z)
            ahead = nearest(self.axes[:, np.abs(self.axes.T @ up) < 0.5], X)
        return np.stack([ahead, cross(up, ahead), up], axis=1)


class Parts:
    """Ids of what a scene reads, of one model."""

    def __init__(self, model: mujoco.MjModel, task: AlohaTask):
        self.task = task
        self.sites = [model.site(f"cali_{side}_site1").id for side in SIDES]
        self.fingers = {
            side: [model.geom(f"vx300s_{side}/10_{finger}_gripper_finger").id for finger in SIDES] for side in SIDES
        }
        self.table = model.geom("table").id
        bodies = {name: model.body(name).id for name in task.objects}
        self.bodies = bodies
        self.geoms = {name: set(np.flatnonzero(model.geom_bodyid == body).tolist()) for name, body in bodies.items()}


class Scene:
    """One state. A task's own scene adds the facts that its rungs ask for."""

    def __init__(self, parts: Parts, data: mujoco.MjData):
        self.task, self._parts = parts.task, parts
        self.hands = {side: _hand(side, number, parts, data) for number, side in enumerate(SIDES)}
        self.left, self.right = self.hands.values()
        self.things = {
            name: Thing(data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy(), parts.task.objects[name])
            for name, body in parts.bodies.items()
        }
        pairs = data.contact.geom[: data.ncon].tolist()
        self._pairs = {(one, two) for one, two in pairs} | {(two, one) for one, two in pairs}

    def touches(self, side: str, name: str) -> tuple[bool, ...]:
        """Return whether the left, and the right, finger of a hand touches an object."""
        return tuple(self._meet([finger], name) for finger in self._parts.fingers[side])

    def on_table(self, name: str) -> bool:
        """Return whether an object touches the table."""
        return self._meet([self._parts.table], name)

    def holds(self, side: str, name: str) -> bool:
        """Return whether a hand has an object between its fingers: both touch it, or it is off the table already.

        In the air a touch that is lost for a moment changes nothing: the fingers close on.
        """
        hand, thing = self.hands[side], self.things[name]
        if not _within(hand.sees(thing.position), HELD_AROUND) or hand.gap < thing.about.thin:
            return False
        return all(self.touches(side, name)) or (thing.position[2] > LIFTED and hand.gap < thing.about.open + SLACK)

    def is_at_grasp(self, side: str, name: str, rotation: F64) -> bool:
        """Return whether a hand may close on an object, or go on closing, to hold it in this rotation (3, 3)."""
        hand, thing = self.hands[side], self.things[name]
        if hand.gap < thing.about.thin:  # closed beside it: open again
            return False
        off, angle = hand.sees(thing.position), angle_between(hand.rotation, rotation)
        if hand.gap < thing.about.open:
            return _within(off, HELD_AROUND) and angle < HELD_ANGLE
        return _within(off, AROUND) and angle < ANGLE

    def observed(self) -> F64:
        """Return `environment_state`, (k,), as the task's `observed` names it."""
        numbers = list[NDArray[Any] | Sequence[float]]()
        for hand in self.hands.values():
            numbers += [hand.position, hand.rotation[:, 0], hand.rotation[:, 1]]
        for name, thing in self.things.items():
            numbers += [thing.position, thing.frame[:, 0], thing.frame[:, 2], [self.on_table(name)]]
            for side, hand in self.hands.items():
                numbers += [hand.sees(thing.position), self.touches(side, name)]
        if self.task.inserted:
            inner, outer = (self.things[name] for name in self.task.inserted)
            numbers += [outer.frame.T @ (inner.position - outer.position), outer.frame.T @ inner.frame[:, 0]]
        return np.concatenate([np.asarray(one, np.float64) for one in numbers])

    def _meet(self, geoms: Iterable[int], name: str) -> bool:
        return any((one, two) in self._pairs for one in geoms for two in self._parts.geoms[name])


def cross(a: F64, b: F64) -> F64:
    """Return the cross product of (3,) and (3,), a tenth of the time of numpy's."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def nearest(axes: F64, way: F64) -> F64:
    """Return the column of `axes` (3, c), with its sign, that is nearest to a way (3,)."""
    along = way @ axes
    best = int(np.abs(along).argmax())
    return axes[:, best] * math.copysign(1.0, along[best])


def ahead_across(ahead: F64, across: F64) -> F64:
    """Return the rotation (3, 3) of a hand that points one way (3,), its fingers nearest to another (3,)."""
    x = ahead / np.linalg.norm(ahead)
    y = across - x * (x @ across)
    y /= np.linalg.norm(y)
    return np.stack([x, y, cross(x, y)], axis=1)


def pitched(across: F64, pitch: float) -> F64:
    """Return the rotation (3, 3) of a hand whose fingers open along a way (3,), levelled; it points down by `pitch`."""
    level = np.array([across[0], across[1], 0.0])
    y = level / np.linalg.norm(level)
    return ahead_across(math.cos(pitch) * cross(y, Z) - math.sin(pitch) * Z, y)


def _hand(side: str, number: int, parts: Parts, data: mujoco.MjData) -> Hand:
    first, site = 8 * number, parts.sites[number]
    gap = 0.5 * float(data.qpos[first + 6] - data.qpos[first + 7]) - FINGER_AT_TOUCH
    position, rotation = data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy()
    return Hand(side, position, rotation, gap, data.qpos[first : first + 6].copy(), Y if side == "left" else -Y)


def _within(off: F64, box: tuple[float, float, float]) -> bool:
    return abs(off[0] - GRASP_AHEAD) < box[0] and abs(off[1]) < box[1] and abs(off[2]) < box[2]
