"""A robot, an arm with a gripper, as dataclasses: one per section of its YAML, which names parts
of its MJCF, and the files of that model, patched as the YAML says.
"""

import importlib.util
import math
import multiprocessing
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import F64
from manip_il.robots.servos import Servos, servo_ranges

_INCLUDE = re.compile(rb"<(?:include|model)\s[^>]*?\bfile\s*=\s*[\"']([^\"']+)")
FRAGMENT = ": it is a fragment; expected the model that includes it"
KEYS = ("model", "includes", "meshes", "mend")  # keys of `ModelFiles` in a YAML


@dataclass(frozen=True)
class ModelFiles:
    """An MJCF and what it needs; paths are absolute.

    Attributes:
        model: The MJCF.
        includes: Folder of the files that the model includes; the model is read as if it lay there.
        meshes: Folder of its meshes.
        mend: Texts in the file and their replacements, for third-party files that do not compile.
    """

    model: Path
    includes: Path | None = None
    meshes: Path | None = None
    mend: Mapping[str, str] = field(default_factory=dict, hash=False)

    @classmethod
    def read(cls, what: str, tree: Mapping[str, Any], folder: Path) -> Self:
        """Return the files that a YAML names.

        Args:
            what: Prefix of the YAML's keys in messages.
            tree: The YAML's part with the keys in `KEYS`; all but `model` may be missing.
            folder: The YAML's folder, to which paths are relative.

        Raises:
            ManipError: If a value is not a text, or names a package that is not installed.
        """
        places = {
            key: place(what + key, tree[key], folder)
            for key in KEYS
            if key in tree and key != "mend"
        }
        return cls(**places, mend=read(f"{what}mend", dict[str, str], tree.get("mend", {})))

    def load(self, robot: str) -> mujoco.MjSpec:
        """Read the model with its included files and its meshes.

        Args:
            robot: The robot's name, for messages.

        Raises:
            UsageError: If a file cannot be read, the model has no joints, or `mend` names a text
                that the file does not have.
        """
        try:
            written = self.model.exists() and self.model.stat().st_mtime_ns
            # a copy does not repeat the warnings at every compilation
            return _parsed(self, written).copy()
        except (ManipError, ValueError) as error:
            why = checks.one_line(error) + FRAGMENT * ("XML model type" in str(error))
            named = "" if str(self.model) in why else f"cannot read {self.model}: "
            raise UsageError(f"robot {robot}: {named}{why}") from None


@cache
def _parsed(files: ModelFiles, written: int) -> mujoco.MjSpec:
    """The model, read once until its file is `written` again."""
    mujoco.set_mju_user_warning(_warn)
    model = checks.read_bytes(files.model, "an MJCF")
    for old, new in files.mend.items():
        if old.encode() not in model:
            raise ManipError(
                f"{files.model} has no {checks.shorten(old)} for mend to replace (included files"
                " are not changed)"
            )
        model = model.replace(old.encode(), new.encode())
    home = files.includes or files.model.parent
    name = str(home / f"mended {files.model.name}")
    _read_included(model, home)  # here first, because MuJoCo would wait for a pipe
    spec = mujoco.MjSpec.from_file(name, include={name: model})
    if files.meshes is not None:
        # MuJoCo prefixes names in an included file with its folder
        for mesh in spec.meshes:
            mesh.file = mesh.file.removeprefix(spec.modelfiledir)
        names = {mesh.file for mesh in spec.meshes if mesh.file}
        spec.assets = {mesh: checks.read_bytes(files.meshes / mesh, "a mesh") for mesh in names}
        spec.meshdir = spec.modelfiledir = ""
    if not spec.joints:
        raise ManipError(f"{files.model} has no joints{FRAGMENT}")
    return spec


def _read_included(model: bytes, home: Path) -> None:
    """Read the files that a model includes or attaches, directly or not.

    Raises `ManipError` for one that is not a regular file.
    """
    read = set[Path]()
    waiting = [model]
    while waiting:
        for name in map(bytes.decode, _INCLUDE.findall(waiting.pop())):
            path = home / name
            if path not in read and path.exists():  # MuJoCo names a missing one
                read.add(path)
                waiting.append(checks.read_bytes(path, "an MJCF"))


@cache
def _warn(text: str) -> None:
    """Print a warning of MuJoCo's, once: a model is read many times, and by every worker."""
    if multiprocessing.parent_process() is None or not text.startswith("Attach conflict"):
        print(f"WARNING: {text}", file=sys.stderr)


def read(what: str, kind: Any, value: Any) -> Any:
    """Convert a YAML's value to a type.

    Args:
        what: The value's name in messages.
        kind: A dataclass (the YAML's keys are its fields), or the type of a tuple, mapping, number
            or text.
        value: The value as the YAML has it.

    Returns:
        The value, an instance of `kind`.

    Raises:
        UnknownName: If the YAML has a key that the dataclass does not have.
        ManipError: If a value is missing, invalid or of the wrong type.
    """
    import draccus  # imported here, as listing the robots does not need it

    if is_dataclass(kind):
        known = [one.name for one in fields(kind)]
        for key in checks.mapping(what, value):
            if key not in known:
                raise UnknownName(f"key in {what}:", key, known)
    try:
        decode: Any = draccus.decode
        return decode(kind, value)
    except ManipError as error:
        raise ManipError(f"{what}.{error}") from None
    except Exception as error:  # draccus also raises plain `Exception`
        line = checks.one_line(error)
        raise ManipError(f"{what} is {checks.shorten(value)}: {line}") from None


def require_lengths(one: Any, **counts: int) -> None:
    """Check how many values the fields of an object have.

    Args:
        one: The object.
        counts: Number of values that each field must have, by the field's name.

    Raises:
        ManipError: If a field has another number of values.
    """
    for name, count in counts.items():
        if len(getattr(one, name)) != count:
            raise ManipError(f"{name} has {len(getattr(one, name))} numbers; expected {count}")


def place(what: str, value: Any, folder: Path) -> Path:
    """Return the path of a file or folder that a YAML names.

    Args:
        what: The value's name in messages.
        value: `PATH`, relative to the YAML's folder, or `PACKAGE:PATH`, in an installed package.
        folder: The YAML's folder.

    Raises:
        ManipError: If the value is not a text, or the package is not installed.
    """
    package, colon, path = checks.text(what, value).partition(":")
    if not colon:
        return folder / package
    found = importlib.util.find_spec(package) if package.isidentifier() else None
    if found is None or found.origin is None:
        raise ManipError(
            f"{what} is in {package!r}, which is not installed; run: pip install --no-deps"
            f" {package.replace('_', '-')} (only its files are needed)"
        )
    return Path(found.origin).parent / path


# offset of the table's middle from the workspace's middle, away from the robot [m]
TABLE_BEYOND = 0.08
RATE = 20  # default control steps per second
GRIPPER = "gripper/"  # prefix of the names of a gripper with a model of its own
JOINT_STEP = 0.1  # largest step of a joint target from the measured position [rad]
# found in the model if the YAML does not give them
FOUND = ("home", "gains", "forces", "armature", "ee")
WRIST = "wrist"  # the camera on the hand
# beside the hand and behind the fingertips, in the frame `ee` [m]
WRIST_CAMERA = (0.10, 0.0, -0.08)


@dataclass(frozen=True)
class EndEffector:
    """Frame `ee`: between the fingertips, z out of the hand, y along the fingers' motion.

    With the hand straight down at zero yaw, its axes are the world's x, -y, -z.

    Attributes:
        body: Name of the body that carries the frame.
        position: Position of the frame in `body`, (3,) [m].
        quaternion: Rotation of the frame in `body`, wxyz.
        lowest: Least height of the frame over the table, at which the fingertips just clear it [m].
    """

    body: str
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    lowest: float = 0.021


@dataclass(frozen=True)
class GripperConfig:
    """A gripper's joints, their positions when it is closed and open, and its fingers.

    Attributes:
        joints: Names of the driven joints.
        closed: Their positions when the gripper is closed, [m] if a joint slides, [rad] if it
            turns.
        open: Their positions when the gripper is open, in the same units.
        fingers: Names of the bodies that touch objects, two or more.
        finger_mass: Mass that replaces every finger's own [kg].
        force: Limit of a driven joint; by default 40 N if it slides and 10 N m if it turns.
        files: The gripper's own model, if any; its names then begin with `gripper/`.
        position: Position of the gripper in the hand's body, (3,) [m].
        quaternion: Rotation of the gripper in the hand's body, wxyz.
    """

    joints: tuple[str, ...]
    closed: tuple[float, ...]
    open: tuple[float, ...]
    fingers: tuple[str, ...]
    finger_mass: float | None = None
    force: float | None = None
    files: ModelFiles | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require_lengths(self, closed=len(self.joints), open=len(self.joints))
        if len(self.fingers) < 2:
            raise ManipError(f"fingers names {len(self.fingers)} bodies; expected two or more")


@dataclass(frozen=True)
class Workspace:
    """Volume in which tasks take place.

    Attributes:
        centre: Its centre on the table, x and y [m].
        half_width: How far it extends from the centre along x and y [m].
        height: How far it extends above the table [m].
    """

    centre: tuple[float, float]
    half_width: float = 0.15
    height: float = 0.45

    def __post_init__(self) -> None:
        if not 0.02 <= min(self.half_width, self.height) <= max(self.half_width, self.height) <= 2:
            raise ManipError(
                f"half_width is {self.half_width:g}, height {self.height:g}; expected 0.02 to 2 m"
            )


@dataclass(frozen=True)
class TableTop:
    """Table of a scene: its lengths along x and y, and the height of its top over the floor [m]."""

    size: tuple[float, float] = (0.9, 1.2)
    height: float = 0.4


@dataclass(frozen=True)
class CameraPose:
    """Pose of a camera in the world: z = 0 is the table's top, x points away from the robot.

    The wrist camera's is in the frame `ee`. If a camera looks straight down, x is up in its
    picture.

    Attributes:
        position: Position of the camera, (3,) [m].
        target: Point that it looks at, (3,) [m].
        fovy: Vertical field of view [deg].
        roll: Turn about its line of sight, counterclockwise seen from behind it [deg].
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fovy: float = 42.0
    # not in the robot's text, which older fingerprints hash; the compiled model has it
    roll: float = field(default=0.0, repr=False)

    @property
    def quaternion(self) -> tuple[float, ...]:
        """Camera axes in MuJoCo's convention, as a quaternion wxyz: x right, y up, z back."""
        back = np.subtract(self.position, self.target)
        back = back / np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right = (
            right / np.linalg.norm(right)
            if np.linalg.norm(right) > 1e-6
            else np.array([0.0, -1.0, 0.0])
        )
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(
            quaternion, np.stack([right, np.cross(back, right), back], axis=1).flatten()
        )
        half = math.radians(self.roll) / 2
        mujoco.mju_mulQuat(quaternion, quaternion.copy(), [math.cos(half), 0, 0, math.sin(half)])
        return tuple(quaternion.tolist())


@dataclass(frozen=True)
class Costs:
    """Costs of inverse kinematics, relative to 1 per metre of position error.

    Attributes:
        orientation: Cost per radian of rotation error.
        leaning: The same for a hand that leans to reach farther.
        posture: Cost per radian of a joint's distance from home.
    """

    orientation: float = 0.2
    leaning: float = 0.04
    posture: float = 0.01


@dataclass(frozen=True)
class LeRobotConfig:
    """A robot as LeRobot's recorder knows it.

    Attributes:
        robot_type: Type of the robot, as in `meta/info.json`.
        names: Names of the servos, the arm's from base to hand, then the gripper's.
        gripper: Positions of the gripper's driven joint at 0 and at 100 [rad].
        fps: Frames per second.
    """

    robot_type: str
    names: tuple[str, ...]
    gripper: tuple[float, float]
    fps: int = RATE

    def __post_init__(self) -> None:
        checks.name("robot_type", self.robot_type)
        if len(set(self.gripper)) != 2:
            raise ManipError(
                f"gripper is {list(self.gripper)}; expected different joint positions [rad] for 0"
                " and 100"
            )

    def percent(self, joint: F64) -> F64:
        """Return the gripper's positions, 0 to 100.

        Args:
            joint: Positions of the gripper's driven joint [rad].
        """
        at_0, at_100 = self.gripper
        return 100 * (joint - at_0) / (at_100 - at_0)


_UPRIGHT_JOINTS = 6  # with fewer joints, a hand cannot point down everywhere
UPRIGHT = Costs()
# for an arm whose hand leans everywhere
SOFT = Costs(orientation=0.02, leaning=0.02, posture=0.002)


@dataclass(frozen=True)
class Robot:
    """A joint-position-controlled arm with a gripper.

    Attributes:
        name: The robot's name.
        files: Its MuJoCo model.
        hand: Name of the body that carries the gripper.
        joints: Names of the arm's joints, base to hand.
        home: A posture over the workspace with the hand down, (arm,) [rad].
        gains: Each joint's kp [N m/rad].
        forces: Each joint's greatest torque [N m].
        armature: Each joint's added inertia [kg m^2].
        ee: The frame between the fingertips.
        gripper: The gripper.
        workspace: Volume in which tasks take place.
        wrist_camera: Name of the model's camera on its hand, or position of an added one in the
            frame `ee` [m].
        cameras: Poses of the cameras front, side and wrist that replace the default ones.
        table: The scene's table.
        base: Position of the root body, (3,) [m]; None: as in the model.
        fixed: Positions of the joints that are neither the arm's nor the gripper's [rad or m].
        max_joint_step: Largest step of a joint target from the measured position [rad].
        colours: Red, green and blue of meshes without contacts, by patterns of their names; later
            patterns win.
        lerobot: How LeRobot's recorder writes the robot; its servos' units then replace [rad]
            and [m].
        servos: How the servos move, by joint and parameter: value, and the ends of its range.
            Empty: they are ideal, and gravity does not act on the arm.
        zeros: What to add to the real arm's joint angles, by joint, as it is calibrated [deg].
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
    wrist_camera: tuple[float, float, float] | str = WRIST_CAMERA
    cameras: Mapping[str, CameraPose] = field(default_factory=dict, hash=False)
    table: TableTop = TableTop()
    base: tuple[float, float, float] | None = None
    fixed: Mapping[str, float] = field(default_factory=dict, hash=False)
    max_joint_step: float = JOINT_STEP
    colours: Mapping[str, tuple[float, float, float]] = field(default_factory=dict, hash=False)
    lerobot: LeRobotConfig | None = None
    # not in the robot's text, which older fingerprints hash
    servos: Servos = field(default_factory=dict, hash=False, repr=False)
    # of the real arm alone
    zeros: Mapping[str, float] = field(default_factory=dict, hash=False, repr=False)

    def __post_init__(self) -> None:
        count = len(self.joints)
        require_lengths(self, home=count, gains=count, forces=count, armature=count)
        if (named := len(self.joint_names)) != count + 1:
            raise ManipError(
                f"lerobot.names has {named} names; expected {count + 1}: the arm's, then the"
                " gripper's"
            )
        for joint, zero in self.zeros.items():
            if joint not in self.plain_names:
                raise UnknownName("joint in zeros:", joint, self.plain_names)
            checks.number(f"zeros.{joint}", zero, -180, 180)
        if self.servos:
            servo_ranges(self.servos, self.joint_names)
            if self.gripper.files or len(self.gripper.joints) != 1:
                raise ManipError("servos need a gripper with one driven joint")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the entries of an action or a state: arm joints, then the gripper."""
        return self.lerobot.names if self.lerobot is not None else (*self.joints, "gripper")

    @property
    def plain_names(self) -> tuple[str, ...]:
        """`joint_names` without the ending of LeRobot's names."""
        return tuple(name.removesuffix(".pos") for name in self.joint_names)

    @property
    def wrist_place(self) -> CameraPose | tuple[float, float, float] | str:
        """The pose in `cameras` of the camera on the hand, else `wrist_camera`."""
        return self.cameras.get(WRIST, self.wrist_camera)

    @property
    def fps(self) -> int:
        """Default control steps per second."""
        return self.lerobot.fps if self.lerobot is not None else RATE

    @property
    def leans(self) -> bool:
        """Whether the hand leans everywhere, as too few joints cannot point it straight down.

        Yaw 0 of such a hand points away from the shoulder, of any other along the world's x.
        """
        return len(self.joints) < _UPRIGHT_JOINTS

    @property
    def costs(self) -> Costs:
        """Costs of inverse kinematics."""
        return SOFT if self.leans else UPRIGHT
