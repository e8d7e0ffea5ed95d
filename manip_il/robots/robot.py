"""A robot as its YAML beside an MJCF has it, checked; what the YAML does not say is found on the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Self

from manip_il import checks
from manip_il.checks import read_yaml
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.robots import ROBOTS
from manip_il.robots.files import KEYS, ModelFiles, try_models
from manip_il.robots.parts import Costs, EndEffector, GripperConfig, Workspace
from manip_il.robots.reading import FURTHEST, missing, names, numbers, tree_of
from manip_il.robots.servos import RATE, LeRobotConfig

SUFFIXES = (".yaml", ".yml")
JOINT_STEP = 0.1  # the longest step of a joint target from the measured joint [rad]
FOUND = ("joints", "home", "gains", "forces", "armature", "ee")  # on the model, where the YAML does not say them
UPRIGHT_JOINTS = 6  # with fewer, a hand cannot point down everywhere
UPRIGHT = Costs()
SOFT = Costs(orientation=0.02, leaning=0.02, posture=0.002)  # of an arm that cannot
YAWS = ("world", "shoulder")


@dataclass(frozen=True)
class Robot:
    """A joint-position-controlled arm with a gripper.

    hand: body that carries the gripper. joints: of the arm, base to hand. home: a posture over the workspace with the
    hand down [rad]. gains, forces, armature: kp of each joint [N m/rad], its greatest torque [N m], and what is added
    to its inertia [kg m^2]. base: of the root body [m]. fixed: where joints stand that are neither the arm's nor the
    gripper's [rad or m]. max_joint_step: the longest step of a joint target from the measured joint [rad]. yaw: where
    a hand's yaw is zero, along the world's x or straight ahead of the shoulder. wrist_camera: the model's own, on its
    hand. colours: red, green and blue of meshes without contacts, by patterns of names, later ones first. lerobot: how
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
    base: tuple[float, ...] | None = None
    fixed: Mapping[str, float] = field(default_factory=dict, hash=False)
    max_joint_step: float = JOINT_STEP
    colours: Mapping[str, tuple[float, ...]] = field(default_factory=dict, hash=False)
    lerobot: LeRobotConfig | None = None

    def __post_init__(self) -> None:
        named, wanted = len(self.joint_names), len(self.joints) + 1
        if named != wanted:
            raise ManipError(f"lerobot.names has {named} names; expected {wanted}: the arm's joints', the gripper's")

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

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a robot's YAML. Raises `UsageError` naming the file and what is wrong in it."""
        said: dict[str, Any] = {}
        try:
            said = cls._said(path, read_yaml(path, "a robot's YAML"))
            if path not in ROBOTS.values():  # what ships has been compiled
                try_models(said["name"], *filter(None, (said["files"], said["gripper"].files)))
            lacking = [name for name in FOUND if name not in said]
            if lacking:
                from manip_il.robots.found import complete  # here, as what ships says it all, and mink takes long

                said = complete(said)
            return cls(**said)
        except ValueError as error:  # MuJoCo's, of a model that it reads and does not compile
            why = " ".join(str(error).split())
            what = "a name is not UTF-8 in" if isinstance(error, UnicodeDecodeError) else "MuJoCo cannot compile"
            raise UsageError(f"{path}: {what} {said['files'].model}: {why}") from None
        except ManipError as error:
            named = str(path) in str(error) or f"robot {path.stem}" in str(error)
            raise UsageError(str(error) if named else f"{path}: {error}") from None

    @classmethod
    def _said(cls, path: Path, tree: Any) -> dict[str, Any]:
        """The fields that a YAML says, and the defaults of those that are not found on the model."""
        tree = tree_of(str(path), tree, cls, without=("name", "files", "hand", *FOUND), more=(*KEYS, "hand", *FOUND))
        if "model" not in tree:
            raise missing(str(path), "model")
        gripper = GripperConfig.read("gripper", tree["gripper"], path.parent)
        said: dict[str, Any] = {
            "name": checks.name("a robot's name", path.stem),
            "files": ModelFiles.read("", tree, path.parent),
            "gripper": gripper,
            "workspace": Workspace.read("workspace", tree["workspace"]),
            "max_joint_step": checks.number("max_joint_step", tree.get("max_joint_step", JOINT_STEP), 1e-3, 1.0),
        }
        if "ee" in tree:
            said["ee"] = EndEffector.read("ee", tree["ee"])
        if "hand" not in tree and "ee" not in tree:
            raise missing(str(path), "hand")
        said["hand"] = checks.text("hand", tree["hand"]) if "hand" in tree else said["ee"].body
        if "wrist_camera" in tree:
            said["wrist_camera"] = checks.text("wrist_camera", tree["wrist_camera"], checks.LONGEST_NAME)
        if tree.get("base") is not None:
            said["base"] = numbers("base", tree["base"], 3, FURTHEST)
        if "lerobot" in tree:
            said["lerobot"] = LeRobotConfig.read("lerobot", tree["lerobot"])
        fixed, colours = (checks.mapping(name, tree.get(name, {})) for name in ("fixed", "colours"))
        said["fixed"] = {name: checks.number(f"fixed: {name}", value, -100, 100) for name, value in fixed.items()}
        said["colours"] = {name: numbers(f"colours: {name}", value, 3, 1.0, 0.0) for name, value in colours.items()}
        return said | _joints(tree, gripper)


def _joints(tree: Mapping[str, Any], gripper: GripperConfig) -> dict[str, Any]:
    """Read what a YAML says of the arm's joints."""
    said: dict[str, Any] = {}
    if "joints" in tree:
        joints = said["joints"] = names("joints", tree["joints"])
        if both := set(joints) & set(gripper.joints):
            raise ManipError(f"joints and gripper.joints both name {min(both)!r}; expected every joint in one of them")
    limits = {"home": (100.0, None), "gains": (1e6, 0.0), "forces": (1e5, 1e-3), "armature": (100.0, 0.0)}
    for name in [name for name in limits if name in tree]:
        if "joints" not in said:
            raise ManipError(f"{name} is given without joints; expected the list of the joints that it is of")
        most, least = limits[name]
        said[name] = numbers(name, tree[name], len(said["joints"]), most, least)
    if "costs" in tree or "joints" in said:
        found = costs_of(len(said["joints"])) if "joints" in said else UPRIGHT
        said["costs"] = Costs.read("costs", tree.get("costs", {}), found)
    if "joints" in said:
        said["yaw"] = yaw_of(len(said["joints"]))
    if "yaw" in tree:
        if tree["yaw"] not in YAWS:
            raise UnknownName("yaw", tree["yaw"], YAWS)
        said["yaw"] = tree["yaw"]
    return said


def costs_of(joints: int) -> Costs:
    """Return the costs that suit an arm of so many joints."""
    return UPRIGHT if joints >= UPRIGHT_JOINTS else SOFT


def yaw_of(joints: int) -> str:
    """Return where the yaw of a hand is zero, of an arm of so many joints."""
    return YAWS[0] if joints >= UPRIGHT_JOINTS else YAWS[1]


def get_robot(name: str) -> Robot:
    """Return a robot by its name in `ROBOTS`, or of a YAML file. Raises `UnknownName`, `UsageError`."""
    if name in ROBOTS:
        return _read(ROBOTS[name])
    if name.endswith(SUFFIXES):
        return _read(Path(name).absolute())
    raise UnknownName("robot", name, ROBOTS, f"known: {', '.join(sorted(ROBOTS))}, or the path of a YAML")


_read = cache(Robot.read)
