"""Parts of a robot as its YAML says them, checked: hand, gripper, workspace, costs of inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np

from manip_il import checks
from manip_il.errors import ManipError
from manip_il.robots.files import KEYS, ModelFiles
from manip_il.robots.reading import FURTHEST, names, numbers, tree_of

TABLE_BEYOND = 0.08  # of the table's middle from the workspace's, away from the robot [m]
GRIPPER = "gripper/"  # prefix of the names of a gripper with a model of its own


@dataclass(frozen=True)
class EndEffector:
    """Frame `ee`: between the fingertips, z out of the hand, y along the fingers' motion.

    With the hand straight down at zero yaw its axes are world x, -y, -z. position [m] and quaternion (wxyz) in `body`.
    lowest: of the frame over the table [m]: the fingertips just clear it.
    """

    body: str
    position: tuple[float, ...]
    quaternion: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    lowest: float = 0.021

    @classmethod
    def read(cls, what: str, tree: Any) -> Self:
        """Make it of what YAML holds; `ManipError` names what is wrong."""
        tree = tree_of(what, tree, cls)
        quaternion = numbers(f"{what}.quaternion", tree.get("quaternion", cls.quaternion), 4, 1.0)
        if np.linalg.norm(quaternion) < 0.1:
            raise ManipError(f"{what}.quaternion is {quaternion}; expected one of length 1, wxyz")
        position = numbers(f"{what}.position", tree["position"], 3, FURTHEST)
        lowest = checks.number(f"{what}.lowest", tree.get("lowest", cls.lowest), 0.0, 0.2)
        return cls(checks.text(f"{what}.body", tree["body"]), position, quaternion, lowest)


@dataclass(frozen=True)
class GripperConfig:
    """The driven joints, where each stands when the gripper is closed and open, and the bodies that touch things.

    finger_mass: of every finger in place of the model's [kg]. force: the most of a driven joint, by default 40 N of one
    that slides and 10 N m of one that turns [N or N m]. files: of a gripper that has a model of its own, whose
    names begin with `gripper/`; position [m] and quaternion (wxyz): of that model in the hand's body.
    """

    joints: tuple[str, ...]
    closed: tuple[float, ...]
    open: tuple[float, ...]
    fingers: tuple[str, ...]
    finger_mass: float | None = None
    force: float | None = None
    files: ModelFiles | None = None
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)

    @classmethod
    def read(cls, what: str, tree: Any, folder: Path) -> Self:
        """Make it of what YAML holds in a folder; `ManipError` names what is wrong."""
        tree = tree_of(what, tree, cls, without=("files",), more=KEYS)
        joints, fingers = (names(f"{what}.{name}", tree[name]) for name in ("joints", "fingers"))
        if len(fingers) < 2:
            raise ManipError(f"{what}.fingers names {len(fingers)}; expected two or more bodies")
        closed, opened = (numbers(f"{what}.{name}", tree[name], len(joints), FURTHEST) for name in ("closed", "open"))
        for joint, at, to in zip(joints, closed, opened, strict=True):
            if at == to:
                raise ManipError(
                    f"{what}.closed and {what}.open are both {at:g} for joint {joint!r}; expected two places"
                )
        mass = tree.get("finger_mass")
        mass = None if mass is None else checks.number(f"{what}.finger_mass", mass, 1e-6, 100)
        force = tree.get("force")
        force = None if force is None else checks.number(f"{what}.force", force, 1e-3, 1e4)
        files = ModelFiles.read(f"{what}.", tree, folder) if "model" in tree else None
        if files is not None:
            joints, fingers = (tuple(GRIPPER + name for name in several) for several in (joints, fingers))
        position = numbers(f"{what}.position", tree.get("position", cls.position), 3, FURTHEST)
        quaternion = numbers(f"{what}.quaternion", tree.get("quaternion", cls.quaternion), 4, 1.0)
        return cls(joints, closed, opened, fingers, mass, force, files, position, quaternion)


@dataclass(frozen=True)
class Workspace:
    """Volume in which tasks take place: +- half_width about the centre on the table, up to a height over it [m]."""

    centre: tuple[float, ...]
    half_width: float = 0.15
    height: float = 0.45

    @classmethod
    def read(cls, what: str, tree: Any) -> Self:
        """Make it of what YAML holds; `ManipError` names what is wrong."""
        tree = tree_of(what, tree, cls)
        half_width, height = (
            checks.number(f"{what}.{name}", tree.get(name, getattr(cls, name)), 0.02, 2)
            for name in ("half_width", "height")
        )
        return cls(numbers(f"{what}.centre", tree["centre"], 2, FURTHEST), half_width, height)


@dataclass(frozen=True)
class Table:
    """Table of a scene: its lengths along x and y, and the height of its top over the floor [m]."""

    size: tuple[float, ...] = (0.9, 1.2)
    height: float = 0.4

    @classmethod
    def read(cls, what: str, tree: Any, space: Workspace) -> Self:
        """Make it of what YAML holds; `ManipError` names what is wrong: a table smaller than the workspace, too."""
        tree = tree_of(what, tree, cls)
        size = numbers(f"{what}.size", tree.get("size", cls.size), 2, FURTHEST, 0.05)
        if min(size[0] / 2 - TABLE_BEYOND, size[1] / 2) < space.half_width:
            wide = 2 * space.half_width
            least = f"{wide + 2 * TABLE_BEYOND:g} by {wide:g} m"
            raise ManipError(f"{what}.size is {list(size)}; expected at least {least} for the workspace")
        return cls(size, checks.number(f"{what}.height", tree.get("height", cls.height), 0.05, 3.0))


@dataclass(frozen=True)
class CameraPose:
    """Place of a camera and of what it looks at in the world, (3,) [m], and its view up and down [deg].

    z = 0 is the table's top, x points away from the robot. Looking straight down, x is up in the picture.
    """

    position: tuple[float, ...]
    target: tuple[float, ...]
    fovy: float = 42.0

    @classmethod
    def read(cls, what: str, tree: Any) -> Self:
        """Make it of what YAML holds; `ManipError` names what is wrong."""
        tree = tree_of(what, tree, cls)
        position, target = (numbers(f"{what}.{name}", tree[name], 3, FURTHEST) for name in ("position", "target"))
        if np.linalg.norm(np.subtract(position, target)) < 0.01:
            raise ManipError(f"{what}: position and target are the same place; expected a direction to look in")
        return cls(position, target, checks.number(f"{what}.fovy", tree.get("fovy", cls.fovy), 1.0, 170.0))

    @property
    def quaternion(self) -> tuple[float, ...]:
        """Axes of the camera as MuJoCo has them, wxyz: x right, y up, z back."""
        back = np.subtract(self.position, self.target)
        back = back / np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([0.0, -1.0, 0.0])
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.stack([right, np.cross(back, right), back], axis=1).flatten())
        return tuple(quaternion.tolist())


@dataclass(frozen=True)
class Costs:
    """Costs of inverse kinematics, beside 1 for a metre off the hand's position.

    orientation: of a radian off its rotation; leaning: the same of a hand that leans to get farther; posture: of a
    radian of a joint off home.
    """

    orientation: float = 0.2
    leaning: float = 0.04
    posture: float = 0.01

    @classmethod
    def read(cls, what: str, tree: Any, found: Costs) -> Costs:
        """Make it of what YAML holds, else of what was found; `ManipError` names what is wrong."""
        tree = tree_of(what, tree, cls)
        values = {
            name: checks.number(f"{what}.{name}", tree.get(name, getattr(found, name)), 1e-6, 100)
            for name in ("orientation", "leaning", "posture")
        }
        return cls(**values)
