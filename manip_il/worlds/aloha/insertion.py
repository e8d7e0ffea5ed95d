"""The left hand takes the socket and the right one the peg.

They meet in the air, and the peg goes in.
"""

import math
from functools import cached_property
from typing import ClassVar

import numpy as np

from manip_il.mdp import F64
from manip_il.robots.geometry import angle_between
from manip_il.worlds.aloha.ladder import (
    ARM,
    PITCH,
    AlohaScene,
    HandRung,
    HandTarget,
    Held,
    Thing,
    Z,
    cross,
    move_object,
    pitched,
    take_rungs,
)

PEG, SOCKET = "peg", "socket"
OF = {"left": SOCKET, "right": PEG}
MEETING = np.array([-0.06, 0.5, 0.10])  # position of the socket for the insertion [m]
WAITING = np.array([0.17, 0.0, 0.0])  # offset of the waiting peg from `MEETING` [m]
# largest errors of the socket's position and rotation for the peg to come [m], [rad]
AT_MEETING, LEVEL = 0.03, 0.2
# place of the peg along the socket's axis: outside, inside; it meets the pin at 0.10 [m]
BEFORE, DEEP = 0.135, 0.085
# funnel: retreat per sideways error of the peg, and tolerated error [m]
SLOPE, TOLERANCE = 8.0, 0.003
ADVANCE = 0.05  # largest advance of the peg in a step [m]
LOW, HIGH = 0.015, 0.055  # heights between which a lifted object begins to move sideways [m]
INSERTED = 0.03  # longest step of a joint while the peg is aligned and inserted [rad]
CARRIED = 0.04  # longest step of a joint while an object is carried [rad]


class Insertion(AlohaScene):
    """One state of the peg-insertion task."""

    name = "AlohaInsertion-v0"
    instruction = "Insert the peg into the socket."
    own = "insertion"
    objects: ClassVar = {PEG: Held(0.018, 0.0075, long=True), SOCKET: Held(0.026, 0.019, long=True)}
    grasped: ClassVar = {PEG: "right", SOCKET: "left"}
    inserted = (PEG, SOCKET)

    @cached_property
    def has(self) -> dict[str, bool]:
        """Whether each hand holds its object."""
        return {side: self.holds(side, name) for side, name in OF.items()}

    @cached_property
    def grasps(self) -> dict[str, F64]:
        """Rotations of the hands that take their objects from the table, (3, 3) each."""
        found = dict[str, F64]()
        for side, name in OF.items():
            across, outward = cross(Z, self.things[name].axes[:, 0]), self.hands[side].outward
            found[side] = pitched(across * math.copysign(1.0, across @ outward), PITCH)
        return found

    @cached_property
    def ready(self) -> bool:
        """Whether the socket is held in place for the insertion."""
        socket = self.things[SOCKET]
        if not self.has["left"] or self.on_table(SOCKET):
            return False
        near = np.linalg.norm(socket.position - MEETING) < AT_MEETING
        return bool(near) and angle_between(socket.frame, np.eye(3)) < LEVEL

    @cached_property
    def depth(self) -> float:
        """Next position of the peg along the socket's axis: straight in, or back if it is
        misaligned [m].
        """
        peg, socket = self.things[PEG], self.things[SOCKET]
        frame = socket.frame
        off = frame.T @ (peg.position - socket.position)
        aside = math.hypot(off[1], off[2]) + ARM * math.acos(
            min(1.0, float(frame[:, 0] @ peg.frame[:, 0]))
        )
        back = min(BEFORE, DEEP + SLOPE * max(0.0, aside - TOLERANCE))
        return max(back, off[0] - ADVANCE)


def _lifted_to(thing: Thing, to: F64) -> F64:
    """Next target (3,) of an object on its way to a place (3,) [m]: up first."""
    share = min(1.0, max(0.0, (thing.position[2] - LOW) / (HIGH - LOW)))
    way = share * (to - thing.position)
    return np.array([thing.position[0] + way[0], thing.position[1] + way[1], to[2]])


def _carry(side: str, to: F64) -> HandRung:
    def target(scene: Insertion) -> HandTarget:
        place = _lifted_to(scene.things[OF[side]], to)
        return move_object(scene, side, OF[side], place, np.eye(3), CARRIED)

    return HandRung("carry", lambda scene: scene.has[side], target)


def _insert(scene: Insertion) -> HandTarget:
    socket = scene.things[SOCKET]
    frame = socket.frame
    return move_object(
        scene, "right", PEG, socket.position + scene.depth * frame[:, 0], frame, INSERTED
    )


Insertion.rungs = {
    "left": (_carry("left", MEETING), *take_rungs("left", SOCKET, lambda one: one.grasps["left"])),
    "right": (
        HandRung(
            "insert", lambda one: one.has["right"] and one.ready and one.depth < BEFORE, _insert
        ),
        HandRung("align", lambda one: one.has["right"] and one.ready, _insert),
        _carry("right", MEETING + WAITING),
        *take_rungs("right", PEG, lambda one: one.grasps["right"]),
    ),
}
