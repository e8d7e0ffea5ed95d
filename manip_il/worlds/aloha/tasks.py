"""The tasks of `gym_aloha`, and what their experts need to know of the objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

SIDES = ("left", "right")
_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
ALOHA_NAMES = tuple(f"{side}_{joint}" for side in SIDES for joint in _JOINTS)  # as in `lerobot/aloha_sim_*`


@dataclass(frozen=True)
class Held:
    """Half gaps between the fingers for one object [m]. open: smallest that clears it; thin: smallest that holds it.

    long: whether the object is longest along its own x axis.
    """

    open: float
    thin: float
    long: bool = False


@dataclass(frozen=True)
class AlohaTask:
    """One task of `gym_aloha`. own: its name there. grasped: the hand that takes each object.

    inserted: an object, and the object that it goes into; empty if nothing is inserted.
    """

    name: str
    instruction: str
    own: str
    objects: Mapping[str, Held]
    grasped: Mapping[str, str]
    rungs: Mapping[str, tuple[str, ...]]
    inserted: tuple[str, ...] = ()

    @property
    def phases(self) -> tuple[str, ...]:
        """`none`, then `LEFT, RIGHT` for every pair of the two hands' rungs, in the order of `rungs`."""
        left, right = (self.rungs[side] for side in SIDES)
        return ("none", *(f"{one}, {other}" for one in left for other in right))


ALOHA_TASKS: dict[str, AlohaTask] = {
    "AlohaTransferCube-v0": AlohaTask(
        "AlohaTransferCube-v0",
        "Pick up the cube with the right arm and transfer it to the left arm.",
        "transfer_cube",
        {"box": Held(0.027, 0.017)},
        {"box": "right"},
        {"left": ("wait", "come", "close", "hold"), "right": ("approach", "grasp", "carry", "release")},
    ),
    "AlohaInsertion-v0": AlohaTask(
        "AlohaInsertion-v0",
        "Insert the peg into the socket.",
        "insertion",
        {"peg": Held(0.018, 0.0075, long=True), "socket": Held(0.026, 0.019, long=True)},
        {"peg": "right", "socket": "left"},
        {"left": ("approach", "grasp", "carry"), "right": ("approach", "grasp", "carry", "align", "insert")},
        ("peg", "socket"),
    ),
}
