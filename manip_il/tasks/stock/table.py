"""The stock tasks by name, without the simulator."""

from __future__ import annotations

from dataclasses import dataclass

from manip_il.errors import UnknownName

ROBOT = "fetch_stock"
CONTROL_HZ, HORIZON = 25, 50
TOLERANCE = 0.05  # distance to the goal within which the reward is 0, else -1 [m]
AXES = ("x", "y", "z")
STATE_NAMES = ("gripper.x", "gripper.y", "gripper.z", "gripper.opening")
ACTION_MEANING = "displacement of the gripper in x, y, z [5 cm], fingers from -1 (close) to 1 (open)"
PHASES = ("none", "approach", "grasp", "carry", "push", "hold")


@dataclass(frozen=True)
class StockTask:
    """One environment. has_object: it moves a cube and not the gripper; blocked: the fingers stay closed.

    module, cls: of gymnasium-robotics.
    """

    name: str
    instruction: str
    module: str
    cls: str
    has_object: bool = True
    blocked: bool = True

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of `environment_state`, (k,): the stock observation, then the goal; lengths in [m]."""
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
    "FetchReach-v4": StockTask(
        "FetchReach-v4", "Move the gripper to the goal", "reach", "MujocoFetchReachEnv", has_object=False
    ),
    "FetchPush-v4": StockTask("FetchPush-v4", "Push the cube to the goal", "push", "MujocoFetchPushEnv"),
    "FetchPickAndPlace-v4": StockTask(
        "FetchPickAndPlace-v4",
        "Bring the cube to the goal",
        "pick_and_place",
        "MujocoFetchPickAndPlaceEnv",
        blocked=False,
    ),
}


def get_stock(name: str) -> StockTask:
    """Return the table's entry; raises `UnknownName`."""
    if name not in STOCK:
        raise UnknownName(f"task of {ROBOT}", name, STOCK)
    return STOCK[name]
