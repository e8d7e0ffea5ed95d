"""Hands, objects and contacts read from one state of two arms, and the rungs that tasks share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import angle_between, turned_towards

SIDES = ("left", "right")
FINGER_AT_TOUCH = 0.0224  # position of a finger joint at which the fingers would touch [m]
GRASP_AHEAD = -0.002  # offset of a held object from the hand's site along the fingers [m]
# largest offset from that place to begin closing, in the hand's axes [m]
AROUND = (0.010, 0.012, 0.010)
HELD_AROUND = (0.020, 0.022, 0.020)  # the same while closing or holding [m]
ANGLE, HELD_ANGLE = 0.25, 0.6  # largest angles to the grasp's rotation, to begin and to hold [rad]
LIFTED = 0.04  # height of an object that has left the table [m]
SLACK = 0.004  # half gap beyond `Held.open` at which fingers still hold an object in the air [m]
X, Y, Z = np.eye(3)

OPEN, CLOSED = 1.0, 0.0
FAST = 0.04  # longest step of a joint [rad]
PITCH = math.radians(60)  # downward pitch of a hand that takes something from the table
STANDOFF = 0.09  # distance from an object at which the hand starts its final approach [m]
# funnel: retreat per sideways error of the hand, and tolerated error [m]
SLOPE, TOLERANCE = 2.0, 0.006
ARM = 0.06  # sideways error that a radian counts as [m/rad]
OPENING_STANDOFF = 0.045  # distance from an object while the fingers are not open [m]
OPENING_SPAN = 0.004  # range of half the gap over which that distance falls to 0 [m]
BACK_FIRST = 0.03  # a hand that is this much too near retreats before it moves sideways [m]
MOST_TURN = 0.3  # largest turn of an object in a step [rad]


@dataclass(frozen=True)
class Held:
    """Half gaps between the fingers for one object.

    Attributes:
        open: Smallest half gap that clears the object [m].
        thin: Smallest half gap that holds it [m].
        long: Whether the object is longest along its own x axis.
    """

    open: float
    thin: float
    long: bool = False


@dataclass(frozen=True)
class Hand:
    """One hand in one state.

    Attributes:
        position: Position of the hand, (3,) [m].
        rotation: Its axes, which point ahead, across and up, (3, 3).
        gap: Half the gap between its fingers [m].
        q: Joints of its arm, (6,) [rad].
        outward: Its across axis if the arm reaches straight to the table's middle, (3,).
    """

    position: F64
    rotation: F64
    gap: float
    q: F64
    outward: F64

    def sees(self, point: F64) -> F64:
        """Return a point (3,) relative to the hand, in its axes [m]."""
        return self.rotation.T @ (point - self.position)


@dataclass(frozen=True)
class Thing:
    """One object in one state.

    Attributes:
        position: Middle of the object, (3,) [m].
        axes: Its axes, (3, 3).
        about: How it is held.
    """

    position: F64
    axes: F64
    about: Held

    @cached_property
    def frame(self) -> F64:
        """Axes, the long one first, with the order and signs nearest to the world's, (3, 3).

        All such frames are equivalent: the object looks the same in each.
        """
        if self.about.long:
            ahead = nearest(self.axes[:, :1], X)
            up = nearest(self.axes[:, 1:], Z)
        else:
            up = nearest(self.axes, Z)
            ahead = nearest(self.axes[:, np.abs(self.axes.T @ up) < 0.5], X)
        return np.stack([ahead, cross(up, ahead), up], axis=1)


class HandRung(NamedTuple):
    """A phase of one hand.

    Attributes:
        name: Name of the phase.
        holds: Returns whether the rung holds in a scene.
        target: Returns the hand's `HandTarget` in a scene.
    """

    name: str
    holds: Callable[[Any], bool]
    target: Callable[[Any], HandTarget]


def always(scene: AlohaScene) -> bool:
    """Return True: the rung holds in every state."""
    return True


class AlohaScene:
    """Hands, objects and contacts in one state of a task of `gym_aloha`.

    A task is a subclass, which gives the attributes, and properties that its rungs need.

    Args:
        model: The environment's model.
        data: The environment's data, with poses and contacts of the state.

    Attributes:
        name: Name of the task.
        instruction: The task in words, for policies that read them.
        own: Its name in `gym_aloha`.
        objects: Object -> how it is held.
        grasped: Object -> the hand that takes it.
        rungs: Hand -> its rungs, the latest first.
        inserted: An object, and the object that it goes into; empty if nothing is inserted.
    """

    name: str
    instruction: str
    own: str
    objects: ClassVar[Mapping[str, Held]]
    grasped: ClassVar[Mapping[str, str]]
    rungs: Mapping[str, tuple[HandRung, ...]]
    inserted: tuple[str, ...] = ()

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        self._model = model
        self.hands = {side: read_hand(side, number, data) for number, side in enumerate(SIDES)}
        self.left, self.right = self.hands.values()
        bodies = {name: data.body(name) for name in self.objects}
        self.things = {
            name: Thing(body.xpos.copy(), body.xmat.reshape(3, 3).copy(), self.objects[name])
            for name, body in bodies.items()
        }
        self._touching = model.geom_bodyid[data.contact.geom]  # (c, 2)

    def touches(self, side: str, name: str) -> tuple[bool, ...]:
        """Return whether each finger of a hand, left and right, touches an object."""
        return tuple(self._meet(f"vx300s_{side}/{finger}_finger_link", name) for finger in SIDES)

    def on_table(self, name: str) -> bool:
        """Return whether an object touches the table."""
        return self._meet("table", name)

    @cached_property
    def arms_touch(self) -> bool:
        """Whether one arm touches the other."""
        arms = {self._model.body(f"vx300s_{side}").id for side in SIDES}
        return any({*pair} == arms for pair in self._model.body_rootid[self._touching].tolist())

    def holds(self, side: str, name: str) -> bool:
        """Return whether a hand has an object between its fingers: both touch it, or it is already
        in the air.

        In the air a brief loss of contact does not matter, as the fingers keep closing.
        """
        hand, thing = self.hands[side], self.things[name]
        if not _within(hand.sees(thing.position), HELD_AROUND) or hand.gap < thing.about.thin:
            return False
        return all(self.touches(side, name)) or (
            thing.position[2] > LIFTED and hand.gap < thing.about.open + SLACK
        )

    def is_at_grasp(self, side: str, name: str, rotation: F64) -> bool:
        """Return whether a hand may close, or keep closing, on an object.

        Args:
            side: The hand, `left` or `right`.
            name: The object.
            rotation: Rotation of the grasp, (3, 3).
        """
        hand, thing = self.hands[side], self.things[name]
        if hand.gap < thing.about.thin:  # closed beside it: open again
            return False
        off, angle = hand.sees(thing.position), angle_between(hand.rotation, rotation)
        if hand.gap < thing.about.open:
            return _within(off, HELD_AROUND) and angle < HELD_ANGLE
        return _within(off, AROUND) and angle < ANGLE

    def observed(self) -> dict[str, F64]:
        """Return the entries of `environment_state` by name: lengths [m], columns of rotations,
        contacts (0, 1).
        """
        found = dict[str, Any]()
        for side, hand in self.hands.items():
            found[f"{side}_ee"] = hand.position
            found[f"{side}_ahead"] = hand.rotation[:, 0]
            found[f"{side}_across"] = hand.rotation[:, 1]
        for name, thing in self.things.items():
            found[name] = thing.position
            found[f"{name}_ahead"] = thing.frame[:, 0]
            found[f"{name}_up"] = thing.frame[:, 2]
            found[f"{name}_on_table"] = self.on_table(name)
            for side, hand in self.hands.items():
                found[f"{name}_from_{side}"] = hand.sees(thing.position)
                touched = zip(SIDES, self.touches(side, name), strict=True)
                found |= {f"{name}_touched.{side}.{finger}": touches for finger, touches in touched}
        if self.inserted:
            one, other = self.inserted
            inner, outer = self.things[one], self.things[other]
            found[f"{one}_from_{other}"] = outer.frame.T @ (inner.position - outer.position)
            found[f"{one}_ahead_in_{other}"] = outer.frame.T @ inner.frame[:, 0]
        return found

    def _meet(self, one: str, other: str) -> bool:
        pair = {self._model.body(one).id, self._model.body(other).id}
        return any(pair == {*bodies} for bodies in self._touching.tolist())


@cache
def phases(task: type[AlohaScene]) -> tuple[str, ...]:
    """Return `none`, then `LEFT, RIGHT` for every pair of the two hands' rungs, earliest first."""
    left, right = (task.rungs[side][::-1] for side in SIDES)
    return ("none", *(f"{one.name}, {other.name}" for one in left for other in right))


def cross(a: F64, b: F64) -> F64:
    """Return the cross product of (3,) and (3,), in a tenth of numpy's time."""
    product = np.empty(3)
    mujoco.mju_cross(product, a, b)
    return product


def nearest(axes: F64, way: F64) -> F64:
    """Return the column of `axes` (3, c), or its negative, that is nearest to a direction (3,)."""
    along = way @ axes
    best = int(np.abs(along).argmax())
    return axes[:, best] * math.copysign(1.0, along[best])


def ahead_across(ahead: F64, across: F64) -> F64:
    """Return the rotation (3, 3) of a hand that points along `ahead` (3,) and opens roughly
    along `across` (3,).
    """
    x = ahead / np.linalg.norm(ahead)
    y = across - x * (x @ across)
    y /= np.linalg.norm(y)
    return np.stack([x, y, cross(x, y)], axis=1)


def pitched(across: F64, pitch: float) -> F64:
    """Return the rotation (3, 3) of a hand pitched down [rad], its fingers opening along the
    level part of `across`.
    """
    level = np.array([across[0], across[1], 0.0])
    y = level / np.linalg.norm(level)
    return ahead_across(math.cos(pitch) * cross(y, Z) - math.sin(pitch) * Z, y)


def read_hand(side: str, number: int, data: mujoco.MjData) -> Hand:
    """Return a hand as it is in `data`.

    Args:
        side: The hand, `left` or `right`.
        number: 0 for the left one, 1 for the right one.
        data: The environment's data, with poses up to date.
    """
    *q, one, other = data.qpos[8 * number : 8 * number + 8].tolist()
    site, gap = data.site(f"cali_{side}_site1"), 0.5 * (one - other) - FINGER_AT_TOUCH
    rotation, outward = site.xmat.reshape(3, 3).copy(), Y if side == "left" else -Y
    return Hand(site.xpos.copy(), rotation, gap, np.array(q), outward)


def _within(off: F64, box: tuple[float, float, float]) -> bool:
    return abs(off[0] - GRASP_AHEAD) < box[0] and abs(off[1]) < box[1] and abs(off[2]) < box[2]


class HandTarget(NamedTuple):
    """Target pose of a hand, (3,) [m] and (3, 3), its gripper's command, and the longest step of
    a joint [rad].
    """

    position: F64
    rotation: F64
    gripper: float
    longest: float = FAST


def close_on(scene: AlohaScene, name: str, rotation: F64, longest: float = FAST) -> HandTarget:
    """Return the target that closes the fingers on an object.

    Args:
        scene: The state.
        name: The object.
        rotation: Rotation of the grasp, (3, 3).
        longest: Longest step of a joint [rad].
    """
    return HandTarget(
        scene.things[name].position - GRASP_AHEAD * rotation[:, 0], rotation, CLOSED, longest
    )


def approach(
    scene: AlohaScene, side: str, name: str, rotation: F64, back: float = 0.0, longest: float = FAST
) -> HandTarget:
    """Return the target that approaches an object with open fingers, in a funnel.

    The hand moves along the grasp's axis. It keeps a distance of `SLOPE` (e - `TOLERANCE`) from the
    object, between `back` and `STANDOFF`, where the error e is its sideways offset plus `ARM` times
    its angle to the grasp. Until its fingers are open, it also stays up to `OPENING_STANDOFF` away.

    Args:
        scene: The state.
        side: The hand, `left` or `right`.
        name: The object.
        rotation: Rotation of the grasp, (3, 3).
        back: Least distance to keep from the object [m].
        longest: Longest step of a joint [rad].
    """
    hand, thing = scene.hands[side], scene.things[name]
    off = rotation.T @ (thing.position - hand.position)
    aside = math.hypot(off[1], off[2]) + ARM * angle_between(hand.rotation, rotation)
    away = max(back, min(STANDOFF, SLOPE * max(0.0, aside - TOLERANCE)))
    if hand.gap < thing.about.open:
        away = max(away, OPENING_STANDOFF * min(1.0, (thing.about.open - hand.gap) / OPENING_SPAN))
    left = off[0] - GRASP_AHEAD
    share = min(1.0, max(0.0, 1.0 - (away - left) / BACK_FIRST))
    way = rotation @ np.array([left - away, share * off[1], share * off[2]])
    return HandTarget(hand.position + way, rotation, OPEN, longest)


def take_rungs(side: str, name: str, grasp: Callable[[Any], F64]) -> tuple[HandRung, HandRung]:
    """Return the rungs of a hand that takes an object from the table, the latest first.

    Args:
        side: The hand, `left` or `right`.
        name: The object.
        grasp: Returns the rotation of the grasp in a scene, (3, 3).
    """
    return (
        HandRung(
            "grasp",
            lambda one: one.is_at_grasp(side, name, grasp(one)),
            lambda one: close_on(one, name, grasp(one)),
        ),
        HandRung("approach", always, lambda one: approach(one, side, name, grasp(one))),
    )


def move_object(
    scene: AlohaScene, side: str, name: str, to: F64, frame: F64, longest: float
) -> HandTarget:
    """Return the target that brings a held object to a place and turns it.

    Args:
        scene: The state.
        side: The hand that holds the object, `left` or `right`.
        name: The object.
        to: The place, (3,) [m].
        frame: The rotation that the object's `Thing.frame` is to have, (3, 3).
        longest: Longest step of a joint [rad].
    """
    hand, thing = scene.hands[side], scene.things[name]
    turn = turned_towards(np.eye(3), frame @ thing.frame.T, MOST_TURN)
    return HandTarget(
        to + turn @ (hand.position - thing.position), turn @ hand.rotation, CLOSED, longest
    )
