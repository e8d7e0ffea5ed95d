"""The right hand takes the cube from the table and hands it to the left one, in the air."""

from functools import cached_property
from typing import ClassVar

import numpy as np

from manip_il.mdp import F64
from manip_il.worlds.aloha.ladder import (
    CLOSED,
    FAST,
    LIFTED,
    OPEN,
    PITCH,
    AlohaScene,
    HandRung,
    HandTarget,
    Held,
    X,
    Z,
    ahead_across,
    always,
    approach,
    close_on,
    nearest,
    pitched,
    take_rungs,
)

CUBE = "box"
MEETING = np.array([0.0, 0.5, 0.25])  # position of the cube for the handover [m]
WAITING = np.array([-0.12, 0.0, 0.0])  # offset of the waiting left hand from `MEETING` [m]
NEAR = 0.1  # distance of the cube from `MEETING` at which the left hand sets out [m]
# largest gap between left hand and cube; `to_go` at which it is 0 [m]
KEPT_OFF, ARRIVED = 0.12, 0.02
LEFT_CLOSED = 0.025  # half the gap below which the left fingers hold the cube [m]
# half the gap at which the right hand leaves; range over which its step grows [m]
OPENED, OPENING = 0.022, 0.004
CLEAR = 0.12  # final distance of the right hand from the cube [m]
# longest joint steps: carrying, handing over, parting [rad]
CARRIED = 0.02
HANDED = 0.03
PARTING = 0.03


class Transfer(AlohaScene):
    """One state of the cube-transfer task."""

    name = "AlohaTransferCube-v0"
    instruction = "Pick up the cube with the right arm and transfer it to the left arm."
    own = "transfer_cube"
    objects: ClassVar = {CUBE: Held(0.027, 0.017)}
    grasped: ClassVar = {CUBE: "right"}

    @cached_property
    def cube(self) -> F64:
        """Middle of the cube, (3,) [m]."""
        return self.things[CUBE].position

    @cached_property
    def right_grasp(self) -> F64:
        """Rotation of the right hand that takes the cube from the table, (3, 3)."""
        axes = self.things[CUBE].axes
        level = axes[:, np.abs(axes.T @ nearest(axes, Z)) < 0.5]
        return pitched(nearest(level, self.right.outward), PITCH)

    @cached_property
    def left_grasp(self) -> F64:
        """Rotation of the left hand that takes the cube from the right one, fingers across the
        other's, (3, 3).
        """
        axes = self.things[CUBE].axes
        between = int(np.abs(self.right.rotation[:, 1] @ axes).argmax())
        free = np.delete(axes, between, axis=1)
        ahead = nearest(free, X)
        across = nearest(free[:, np.abs(free.T @ ahead) < 0.5], Z)
        return ahead_across(ahead, across)

    @cached_property
    def lifted(self) -> bool:
        """Whether the cube has left the table."""
        return bool(self.cube[2] > LIFTED) and not self.on_table(CUBE)

    @cached_property
    def right_holds(self) -> bool:
        """Whether the right hand has the cube."""
        return self.holds("right", CUBE)

    @cached_property
    def left_holds(self) -> bool:
        """Whether the left hand has the cube, in the air."""
        return self.lifted and self.holds("left", CUBE) and all(self.touches("left", CUBE))

    @cached_property
    def to_go(self) -> float:
        """Distance of the cube from the place of the handover [m]."""
        return float(np.linalg.norm(self.cube - MEETING))


def _let_go(scene: Transfer) -> HandTarget:
    """Open, then back off."""
    hand = scene.right
    share = max(0.0, min(1.0, (hand.gap - OPENED) / OPENING))
    way = max(0.0, CLEAR - abs(hand.sees(scene.cube)[0]))
    return HandTarget(
        hand.position - share * way * hand.rotation[:, 0], hand.rotation, OPEN, PARTING
    )


def _carry(scene: Transfer) -> HandTarget:
    hand = scene.right
    return HandTarget(
        hand.position + MEETING - scene.cube, pitched(hand.outward, PITCH), CLOSED, CARRIED
    )


def _come(scene: Transfer) -> HandTarget:
    back = min(KEPT_OFF, 2 * max(0.0, scene.to_go - ARRIVED))
    return approach(scene, "left", CUBE, scene.left_grasp, back, HANDED)


def _wait(scene: Transfer) -> HandTarget:
    return HandTarget(MEETING + WAITING, ahead_across(X, Z), OPEN, FAST)


Transfer.rungs = {
    "left": (
        HandRung(
            "hold",
            lambda one: one.left_holds,
            lambda one: HandTarget(one.left.position, one.left.rotation, CLOSED),
        ),
        HandRung(
            "close",
            lambda one: one.lifted and one.is_at_grasp("left", CUBE, one.left_grasp),
            lambda one: close_on(one, CUBE, one.left_grasp, CARRIED),
        ),
        HandRung("come", lambda one: one.right_holds and one.lifted and one.to_go < NEAR, _come),
        HandRung("wait", always, _wait),
    ),
    "right": (
        HandRung("release", lambda one: one.left_holds and one.left.gap < LEFT_CLOSED, _let_go),
        HandRung("carry", lambda one: one.right_holds, _carry),
        *take_rungs("right", CUBE, lambda one: one.right_grasp),
    ),
}
