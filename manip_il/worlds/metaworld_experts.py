"""Experts of those of Meta-World's tasks in which the package's scripts fail or do not recover.

The scripts close the gripper on the way down and carry what they do not hold; what a slip, a push
or a random action changed, they do not see. Each expert here is a stateless ladder over the 39
numbers that are seen: hand (3,) [m], opening of the gripper (a share), object (3,) [m] and its
quaternion (4,), second object (3,) [m], the same 18 numbers of the step before, goal (3,) [m].
Lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from manip_il.mdp import F64

GAIN = 15.0  # action for an error of the hand [1/m]
LAG = 2.0  # steps that the hand is behind its command
LEAD = 6.0  # steps that the hand aims ahead of an object that rolls
OPEN, CLOSED = -1.0, 1.0  # effort of the gripper
CLEARANCE = 0.1  # of the hand above what it approaches [m]
EMPTY = 0.85  # opening above which nothing is held
CLOSING = 0.01  # change of the opening in a step, above which the gripper still closes
UP = np.array([0.0, 0.0, 1.0])
Expert = Callable[[F64], F64]  # the action (4,) for what is seen, (39,)


def reach(seen: F64, target: F64, effort: float) -> F64:
    """Return the action that moves the hand to a target.

    Args:
        seen: The observation, (39,).
        target: Place of the hand, (3,) [m].
        effort: Of the gripper, -1 (opens) to 1 (closes).

    Returns:
        The action, (4,), between -1 and 1.
    """
    hand, before = seen[:3], seen[18:21]
    error = target - hand - LAG * (hand - before)
    return np.clip(np.append(GAIN * error, effort), -1.0, 1.0)


def approach(seen: F64, place: F64, effort: float, height: float = CLEARANCE) -> F64:
    """Return the action that goes above a place, and down to it where the hand is above it.

    Args:
        seen: The observation, (39,).
        place: Place of the hand, (3,) [m].
        effort: Of the gripper, -1 (opens) to 1 (closes).
        height: Of the way there above the place [m].

    Returns:
        The action, (4,), between -1 and 1.
    """
    apart = np.hypot(*(seen[:3] - place)[:2])
    return reach(seen, place + height * np.clip(apart / 0.02 - 0.8, 0, 1) * UP, effort)


def grasp(
    seen: F64, at: F64, carried: F64, near: float = 0.02, deep: float = 0.02, empty: float = EMPTY
) -> F64:
    """Return the action that carries an object if it is held, and grasps it otherwise.

    A hand that is not around the object opens and goes above it, however it got there.

    Args:
        seen: The observation, (39,).
        at: Place of the hand in which it grasps, (3,) [m].
        carried: Target of the hand if the object is held, (3,) [m].
        near: Most error of the hand in the plane [m].
        deep: Most error of the hand in height [m].
        empty: Opening above which nothing is held.

    Returns:
        The action, (4,), between -1 and 1.
    """
    opening, closing = seen[3], seen[21] - seen[3]
    moved = seen[4:7] - seen[22:25]
    error = seen[:3] - at
    apart = float(np.hypot(*error[:2]))
    if apart < near and abs(error[2]) < deep:
        is_held = opening < empty and closing < CLOSING
        return reach(seen, carried if is_held else at, CLOSED)
    # clear of the object until the hand is above it and open
    clear = np.clip(max(apart / near - 0.8, 5 * (empty - opening)), 0, 1)
    return reach(seen, at + LEAD * moved + CLEARANCE * clear * UP, OPEN)


def over(seen: F64, point: F64, goal: F64, height: float, near: float = 0.02) -> F64:
    """Return the hand's target that carries a point of a held object up, over a goal, and down.

    Args:
        seen: The observation, (39,).
        point: Place of the point, (3,) [m].
        goal: Where it shall be, (3,) [m].
        height: Of the way above the goal [m].
        near: Distance in the plane within which it is lowered [m].

    Returns:
        The target, (3,) [m].
    """
    left = goal - point
    if np.hypot(*left[:2]) > near:
        left[2] += height
        left[:2] *= np.clip(1 - 20 * left[2], 0, 1)  # first up
    return seen[:3] + left


def axis(quaternion: F64, column: int) -> F64:
    """Return an axis of a frame that a quaternion (w, x, y, z) turns, (3,)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )[column]


def _assembly(seen: F64) -> F64:
    """Put the wrench's ring over the peg."""
    wrench = seen[4:7]
    ring = wrench + 0.13 * axis(seen[7:11], 1)
    to = over(seen, ring, seen[36:39] - 0.05 * UP, 0.12, 0.012)
    return grasp(seen, wrench + (-0.015, 0, 0.047), to)


def _disassemble(seen: F64) -> F64:
    """Lift the wrench off the peg."""
    hand, wrench = seen[:3], seen[4:7]
    along = axis(seen[7:11], 1)
    if abs(along[0]) < 0.4:  # between the fingers it would lie lengthwise, so it is turned first
        sign = 1.0 if along[0] * along[1] >= 0 else -1.0
        aside = sign * np.array([-along[1], along[0], 0.0])
        beside = wrench - 0.06 * aside + 0.04 * UP
        error = hand - beside
        if hand[2] < beside[2] + 0.022 and abs(error @ along) < 0.04 and error @ aside > -0.02:
            return reach(seen, beside + 0.1 * aside, OPEN)
        return approach(seen, beside, OPEN)
    at = wrench + 0.02 * along + 0.04 * UP
    return grasp(seen, at, seen[:3] + 0.1 * UP, 0.02, 0.025)


def _hammer(seen: F64) -> F64:
    """Hit the nail with the hammer's head."""
    tool = seen[4:7]
    left = np.array([0.078, 0.75, 0.125]) - tool  # its head is then where the driven nail is
    if abs(left[0]) + abs(left[2]) > 0.02:
        left[1] = 0.45 - tool[1]
    return grasp(seen, tool + (-0.025, 0, 0.038), seen[:3] + left)


def _hand_insert(seen: F64) -> F64:
    """Carry the block down into the hole."""
    hand = seen[:3]
    block, goal = seen[4:7], seen[36:39]
    if block[2] < 0.04 and block[1] > 0.86:  # by the hole's wall, no finger fits: drag it
        top = block + 0.06 * UP
        error = hand - top
        if np.hypot(*error[:2]) < 0.02 and error[2] < 0.02:
            return reach(seen, hand + (*(goal - block)[:2], -0.1), CLOSED)
        return approach(seen, top - 0.02 * UP, CLOSED)
    return grasp(seen, block + 0.04 * UP, over(seen, block, goal - 0.03 * UP, 0.1), 0.02, 0.03)


def _coffee(seen: F64) -> F64:
    """Carry the mug to the goal, also one that has fallen."""
    mug, upright = seen[4:7], axis(seen[[10, 7, 8, 9]], 2)  # the quaternion is (x, y, z, w)
    to = seen[:3] + seen[36:39] - mug + 0.01 * UP
    return grasp(seen, mug + 0.05 * upright + 0.015 * UP, to, 0.03)


def _peg_insert(seen: F64) -> F64:
    """Push the peg into the hole."""
    peg, goal = seen[4:7], seen[36:39]
    left = goal - (0.1, 0, 0) - peg
    if np.hypot(*left[1:]) > 0.01:
        left[0] = max(0.03 - peg[0], 0)  # away from the box until it is in line with the hole
    return grasp(seen, peg + 0.02 * UP, seen[:3] + left, 0.03)


def _place(grip: float, height: float, around: float = 0.02) -> Expert:
    """Return an expert that carries an object up, over the goal, and down.

    Args:
        grip: Height of the hand above the object in which it grasps [m].
        height: Of the way above the goal [m].
        around: Most error of the grasping hand in the plane [m].
    """

    def act(seen: F64) -> F64:
        thing, goal = seen[4:7], seen[36:39]
        return grasp(seen, thing + grip * UP, over(seen, thing, goal, height), around)

    return act


def _carry(seen: F64) -> F64:
    """Carry an object straight to the goal."""
    thing = seen[4:7]
    return grasp(seen, thing + 0.03 * UP, seen[:3] + seen[36:39] - thing, 0.03)


def _wall(seen: F64) -> F64:
    """Carry the object over the wall."""
    thing, goal = seen[4:7], seen[36:39]
    return grasp(seen, thing + 0.03 * UP, over(seen, thing, goal, 0.3 - goal[2]))


def _peg_unplug(seen: F64) -> F64:
    """Pull the peg out of its hole."""
    peg, goal = seen[4:7], seen[36:39]
    pulled = seen[:3] + np.clip(goal - peg, -0.02, 0.02)  # slowly, not to slip
    return grasp(seen, peg + (-0.035, 0, 0.015), pulled, 0.03, empty=1.01)


def _stick_push(seen: F64) -> F64:
    """Push the bottle with the stick."""
    stick, bottle = seen[4:7], seen[11:14]
    goal = seen[36:39]
    left = bottle - stick
    if abs(left[1]) + abs(left[2]) > 0.02:
        left[0] = 0
    else:
        left = goal - bottle + (0.05, 0, 0)  # past the goal, as it pushes
    return grasp(seen, stick + (0.015, 0, 0.03), seen[:3] + left)


def _stick_pull(seen: F64) -> F64:
    """Put the stick through the bottle's handle and pull."""
    stick, handle = seen[4:7], seen[11:14]
    goal = seen[36:39]
    left = handle - stick
    if left[0] < 0.03 and max(abs(left[1:])) < 0.04:
        left[:2] = (goal - handle)[:2]
    elif max(abs(left[1:])) > 0.015:
        left[0] = 0
    return grasp(seen, stick + (-0.015, 0, 0.035), seen[:3] + left)


def _handle_pull_side(seen: F64) -> F64:
    """Pull the handle up."""
    return grasp(seen, seen[4:7], seen[:3] + 0.1 * UP, 0.03, 0.03)


def _door_open(seen: F64) -> F64:
    """Pull the door open by its handle, from behind it."""
    hand, handle = seen[:3], seen[4:7]
    behind = handle + (0.01, 0.02, 0)
    error = hand - behind
    is_near = np.hypot(*error[:2]) < 0.07 and error[0] > -0.05
    if is_near and abs(error[2]) < 0.04:
        return reach(seen, handle - (0.05, 0, 0), CLOSED)
    return approach(seen, behind, CLOSED, 0.15)


EXPERTS: dict[str, Expert] = {
    "assembly-v3": _assembly,
    "basketball-v3": _place(0.035, 0.07, around=0.03),  # into the hoop
    "box-close-v3": _place(0.07, 0.05),  # the lid on the box
    "coffee-pull-v3": _coffee,
    "coffee-push-v3": _coffee,
    "disassemble-v3": _disassemble,
    "door-open-v3": _door_open,
    "hammer-v3": _hammer,
    "hand-insert-v3": _hand_insert,
    "handle-pull-side-v3": _handle_pull_side,
    "peg-insert-side-v3": _peg_insert,
    "peg-unplug-side-v3": _peg_unplug,
    "pick-out-of-hole-v3": _place(0.03, 0.0),  # out of the hole
    "pick-place-v3": _carry,
    "pick-place-wall-v3": _wall,
    "push-v3": _carry,
    "push-wall-v3": _wall,
    "push-back-v3": _carry,
    "shelf-place-v3": _place(0.03, 0.03),
    "soccer-v3": _place(0.015, 0.0, around=0.03),  # the ball is held
    "stick-pull-v3": _stick_pull,
    "stick-push-v3": _stick_push,
    "sweep-v3": _carry,
    "sweep-into-v3": _carry,
}
