"""A robot: an arm with a gripper, by the names in its MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from manip_il.errors import ManipError, UnknownName
from manip_il.robots.files import ModelFiles
from manip_il.robots.parts import (
    RATE,
    TABLE_BEYOND,
    CameraPose,
    Costs,
    EndEffector,
    GripperConfig,
    LeRobotConfig,
    Table,
    Workspace,
)
from manip_il.robots.reading import require_lengths

JOINT_STEP = 0.1  # the longest step of a joint target from the measured joint [rad]
FOUND = ("joints", "home", "gains", "forces", "armature", "ee")  # on the model, where the YAML does not say them
UPRIGHT_JOINTS = 6  # with fewer, a hand cannot point down everywhere
UPRIGHT = Costs()
SOFT = Costs(orientation=0.02, leaning=0.02, posture=0.002)  # of an arm that cannot
TABLE = Table()
YAWS = ("world", "shoulder")


@dataclass(frozen=True)
class Robot:
    """A joint-position-controlled arm with a gripper.

    hand: body that carries the gripper. joints: of the arm, base to hand. home: a posture over the workspace with
    the hand down [rad]. gains, forces, armature: kp of each joint [N m/rad], its greatest torque [N m], and what is
    added to its inertia [kg m^2]. base: of the root body [m]. fixed: where joints stand that are neither the arm's
    nor the gripper's [rad or m]. max_joint_step: the longest step of a joint target from the measured joint [rad].
    yaw: where a hand's yaw is zero, along the world's x or straight ahead of the shoulder. wrist_camera: the
    model's own, on its hand. cameras: of the scene, where they do not stand as for every robot: front, side. table: of
    the scene.
    colours: red, green and blue of meshes without contacts, by patterns of names, later ones first. lerobot: how
    LeRobot's recorder writes it, where its servos' numbers are wanted in place of [rad] and [m].
    """

    name: str
    files: ModelFiles
    hand: str
    joints: tuple[str, ...]
    home: tuple[float, ...]
    gains: tuple[float, ...]
    forces: tuple[float, ...]
    armature: tuple[float, ...]
    ee: EndEffector
    gripper: GripperConfig
    workspace: Workspace
    costs: Costs = UPRIGHT
    yaw: str = "world"
    wrist_camera: str = ""
    cameras: Mapping[str, CameraPose] = field(default_factory=dict, hash=False)
    table: Table = TABLE
    base: tuple[float, ...] | None = None
    fixed: Mapping[str, float] = field(default_factory=dict, hash=False)
    max_joint_step: float = JOINT_STEP
    colours: Mapping[str, tuple[float, ...]] = field(default_factory=dict, hash=False)
    lerobot: LeRobotConfig | None = None

    def __post_init__(self) -> None:
        count = len(self.joints)
        require_lengths(self, home=count, gains=count, forces=count, armature=count)
        if both := set(self.joints) & set(self.gripper.joints):
            raise ManipError(f"joints and gripper.joints both name {min(both)!r}; expected every joint in one of them")
        if (named := len(self.joint_names)) != count + 1:
            raise ManipError(f"lerobot.names has {named} names; expected {count + 1}: the arm's joints', the gripper's")
        if self.yaw not in YAWS:
            raise UnknownName("yaw", self.yaw, YAWS)
        if not 0 < self.max_joint_step <= 1:
            raise ManipError(f"max_joint_step is {self.max_joint_step:g}; expected more than 0 and at most 1 rad")
        (x, y), wide = self.table.size, 2 * self.workspace.half_width
        if x < wide + 2 * TABLE_BEYOND or y < wide:
            least = f"{wide + 2 * TABLE_BEYOND:g} by {wide:g} m"
            raise ManipError(f"table.size is {x:g} by {y:g} m; expected at least {least} for the workspace")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of `observation.state` and `action`: arm joints, then the gripper."""
        return self.lerobot.names if self.lerobot is not None else (*self.joints, "gripper")

    @property
    def fps(self) -> int:
        """Control steps a second, where nothing else is said."""
        return self.lerobot.fps if self.lerobot is not None else RATE

    @property
    def leans(self) -> bool:
        """Whether the hand leans wherever it is, as an arm of too few joints cannot hold it upright."""
        return self.costs.orientation == self.costs.leaning


def costs_of(joints: int) -> Costs:
    """Return the costs that suit an arm of so many joints."""
    return UPRIGHT if joints >= UPRIGHT_JOINTS else SOFT


def yaw_of(joints: int) -> str:
    """Return where the yaw of a hand is zero, of an arm of so many joints."""
    return YAWS[0] if joints >= UPRIGHT_JOINTS else YAWS[1]
