"""The stock tasks by name, without the simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from manip_il.option import NameOrPath
from manip_il.sim.config import OTHERS

ROBOT = "fetch_stock"
CONTROL_HZ, HORIZON = 25, 50
TOLERANCE = 0.05  # distance to the goal within which the reward is 0, else -1 [m]
AXES = ("x", "y", "z")
STATE_NAMES = ("gripper.x", "gripper.y", "gripper.z", "gripper.opening")
ACTION_MEANING = "displacement of the gripper in x, y, z [5 cm], fingers from -1 (close) to 1 (open)"
PHASES = ("none", "approach", "grasp", "carry", "push", "hold")


@dataclass(frozen=True)
class StockTask:
    """A stock task. has_object: the goal is for a cube, not for the gripper; blocked: the fingers stay closed."""

    name: str
    instruction: str
    has_object: bool = True
    blocked: bool = True
    phases: tuple[str, ...] = PHASES

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of the entries of `environment_state`, (k,): the stock observation, then the goal; lengths in [m]."""
        things = ("object", "object_offset") if self.has_object else ()
        turning = ("object_turn", "object_velocity", "object_spin") if self.has_object else ()
        fingers = ("finger.right", "finger.left")
        return (
            *_vectors("ee", *things),
            *fingers,
            *_vectors(*turning, "ee_velocity"),
            *(f"{name}.velocity" for name in fingers),
            *_vectors("goal"),
        )


def _vectors(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}.{axis}" for name in names for axis in AXES)


STOCK: dict[str, StockTask] = {
    "FetchReach-v4": StockTask("FetchReach-v4", "Move the gripper to the goal", has_object=False),
    "FetchPush-v4": StockTask("FetchPush-v4", "Push the cube to the goal"),
    "FetchPickAndPlace-v4": StockTask("FetchPickAndPlace-v4", "Bring the cube to the goal", blocked=False),
}
ALOHA = "aloha"
TWO_ARMS = "joint position targets [rad], gripper command [0 to 1], of two arms"
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

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of the entries of `environment_state`, (k,): lengths [m], entries of rotations, and contacts (0, 1)."""
        names = [name for side in SIDES for name in _vectors(f"{side}_ee", f"{side}_ahead", f"{side}_across")]
        for thing in self.objects:
            names += [*_vectors(thing, f"{thing}_ahead", f"{thing}_up"), f"{thing}_on_table"]
            for side in SIDES:
                names += _vectors(f"{thing}_from_{side}")
                names += [f"{thing}_touched.{side}.{finger}" for finger in SIDES]
        if self.inserted:
            one, other = self.inserted
            names += _vectors(f"{one}_from_{other}", f"{one}_ahead_in_{other}")
        return tuple(names)


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


@dataclass(frozen=True)
class StockRobot:
    """The environments of one package. fixed: settings of `EnvConfig` that cannot change; horizon: the default.

    cameras: their names, the default one first. ends_solved: whether an episode ends once it is solved.
    """

    tasks: Mapping[str, StockTask | AlohaTask]
    joint_names: tuple[str, ...]
    action_meaning: str
    horizon: int
    fixed: Mapping[str, float]
    cameras: tuple[str, ...] = ()
    ends_solved: bool = field(default=False, kw_only=True)


ROBOTS: dict[NameOrPath, StockRobot] = {
    ROBOT: StockRobot(
        STOCK,
        STATE_NAMES,
        ACTION_MEANING,
        HORIZON,
        {"control_hz": CONTROL_HZ, "tolerance": TOLERANCE, "success_steps": 1, "horizon": HORIZON},
    ),
    ALOHA: StockRobot(
        ALOHA_TASKS,
        ALOHA_NAMES,
        TWO_ARMS,
        400,  # as in LeRobot's environment; the one registered with gymnasium has 300
        {"control_hz": 50, "tolerance": TOLERANCE, "success_steps": 1},  # the reward shows when it is solved
        OTHERS,
        ends_solved=True,
    ),
}
