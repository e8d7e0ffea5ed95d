"""A cabinet with a drawer that has a handle: what it is built of, and how far it is open."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.world import World
from manip_il.tasks.objects import GREY, WOOD, add_furniture, add_part

F64 = NDArray[np.float64]

CABINET, TRAY, BAR = "cabinet", "drawer", "handle"
# The cabinet's frame lies on the table under the handle of the closed drawer, x into the cabinet.
GAP = 0.056  # of the handle's middle from the drawer's front [m]
INSIDE = (0.05, 0.06)  # half the drawer's inner length and width [m]
WALL, FLOOR, PANEL, THIN = 0.035, 0.010, 0.090, 0.004  # of the drawer: height of walls, floor, front; half a wall [m]
ROOF = 0.080  # of the cabinet, over the table, on the inside [m]
MIDDLE = GAP + 2 * THIN + INSIDE[0]  # of the drawer's inside from its handle [m]
BAR_Z, BAR_HALF, BAR_LENGTH = 0.080, 0.006, 0.05  # of the handle: height, half its thickness, half its length [m]
OPEN = 0.12  # how far the drawer is pulled [m]
HAND_Z = BAR_Z - 0.005  # of the hand at the handle [m]


def add_cabinet(spec: mujoco.MjSpec) -> None:
    """Add a cabinet with a drawer that slides out towards the robot."""
    cabinet = add_furniture(spec, CABINET)
    front = GAP + 2 * THIN  # where the drawer's inside begins
    length, width = INSIDE
    deep, wide = length + 2 * THIN, width + 3 * THIN  # of the cabinet, half
    back = front + 2 * deep
    for side, sign in (("left", 1), ("right", -1)):
        add_part(
            cabinet, f"cabinet {side}", (deep, THIN, ROOF / 2), (front + deep, sign * (wide + THIN), ROOF / 2), WOOD
        )
    add_part(cabinet, "cabinet back", (THIN, wide + 2 * THIN, ROOF / 2), (back + THIN, 0, ROOF / 2), WOOD)
    add_part(cabinet, "cabinet top", (deep + THIN, wide + 2 * THIN, THIN), (front + deep + THIN, 0, ROOF + THIN), WOOD)
    tray = cabinet.add_body(name=TRAY)
    tray.add_joint(
        name=TRAY, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[-1, 0, 0], limited=True, range=[0, OPEN],
        damping=[5.0, 0, 0], frictionloss=0.5, armature=0.05,
    )  # fmt: skip
    middle = front + length
    add_part(tray, "drawer floor", (length, width, THIN), (middle, 0, FLOOR - THIN), WOOD)
    for side, sign in (("left", 1), ("right", -1)):
        add_part(tray, f"drawer {side}", (length, THIN, WALL / 2), (middle, sign * (width + THIN), WALL / 2), WOOD)
    back_z, back_half = (ROOF - THIN + FLOOR) / 2, (ROOF - THIN - FLOOR) / 2  # so high that nothing gets behind it
    add_part(tray, "drawer back", (THIN, width, back_half), (front + 2 * length + THIN, 0, back_z), WOOD)
    add_part(tray, "drawer front", (THIN, wide + 2 * THIN, PANEL / 2), (GAP + THIN, 0, PANEL / 2), WOOD)
    add_part(tray, BAR, (BAR_HALF, BAR_LENGTH, BAR_HALF), (0, 0, BAR_Z), GREY)
    for side, sign in (("left", 1), ("right", -1)):
        add_part(tray, f"{BAR} {side}", (GAP / 2, BAR_HALF, BAR_HALF), (GAP / 2, sign * BAR_LENGTH, BAR_Z), GREY)
    spec.add_exclude(bodyname1=CABINET, bodyname2=TRAY)


def pulled(world: World) -> float:
    """Return how far the drawer is open [m]."""
    return float(world.pose(CABINET).position[0] - world.pose(TRAY).position[0])


def middle_of_drawer(world: World) -> F64:
    """Return the middle of the drawer's floor, (3,) [m]."""
    return world.pose(TRAY).position + [MIDDLE, 0.0, FLOOR]


def hand_at_handle(world: World) -> F64:
    """Return where the hand has the handle between its fingers, (3,) [m]."""
    return world.pose(TRAY).position + [0.0, 0.0, HAND_Z]
