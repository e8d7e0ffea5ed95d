"""Rungs of two hands, and the ways of a hand that every task has."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from manip_il.robots.rotations import angle_between, turned_towards
from manip_il.tasks.stock.aloha.scene import GRASP_AHEAD, Scene

F64 = NDArray[np.float64]

OPEN, CLOSED = 1.0, 0.0
FAST = 0.04  # longest step of a joint [rad]
PITCH = math.radians(60)  # by which a hand points down when it takes something from the table
STANDOFF = 0.09  # before an object where the hand goes down to it from [m]
SLOPE, TOLERANCE = 2.0, 0.006  # of the funnel: the way back for what the hand is aside of its line, but for so much [m]
ARM = 0.06  # lever by which an angle counts as a way aside [m/rad]
OPENING_STANDOFF = 0.045  # before an object while the fingers are not open [m]
OPENING_SPAN = 0.004  # of half the gap, over which that falls to nothing [m]
BACK_FIRST = 0.03  # a hand that is so much too near does not go sideways before it has gone back [m]
MOST_TURN = 0.3  # of an object in a step [rad]


class Target(NamedTuple):
    """Pose that a hand is to have, (3,) [m] and (3, 3), its gripper's command, the longest step of a joint [rad]."""

    position: F64
    rotation: F64
    gripper: float
    longest: float = FAST


class Rung(NamedTuple):
    """A phase of one hand: whether it holds in a task's scene, and its target there."""

    name: str
    holds: Callable[[Any], bool]
    target: Callable[[Any], Target]


def always(scene: Scene) -> bool:
    """Hold in every state."""
    return True


def close_on(scene: Scene, side: str, name: str, rotation: F64, longest: float = FAST) -> Target:
    """Close where the object is, in a grasp's rotation (3, 3)."""
    return Target(scene.things[name].position - GRASP_AHEAD * rotation[:, 0], rotation, CLOSED, longest)


def approach(scene: Scene, side: str, name: str, rotation: F64, back: float = 0.0, longest: float = FAST) -> Target:
    """Go to an object in a funnel along the hand's own way ahead, open.

    rotation: of the grasp, (3, 3). back: stay at least so far before it [m].
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
    return Target(hand.position + way, rotation, OPEN, longest)


def move_object(scene: Scene, side: str, name: str, to: F64, frame: F64, longest: float) -> Target:
    """Bring an object that a hand holds to a place (3,) [m] and its `frame` to axes (3, 3)."""
    hand, thing = scene.hands[side], scene.things[name]
    turn = turned_towards(np.eye(3), frame @ thing.frame.T, MOST_TURN)
    return Target(to + turn @ (hand.position - thing.position), turn @ hand.rotation, CLOSED, longest)
