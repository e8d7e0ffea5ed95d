"""A robot as its YAML beside an MJCF has it, checked."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Self

import mujoco
import numpy as np

from manip_il import checks
from manip_il.checks import read_yaml
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.robots import ROBOTS

SUFFIXES = (".yaml", ".yml")
JOINT_STEP = 0.1  # the longest step of a joint target from the measured joint [rad]
_MOST_JOINTS = 100
_FURTHEST = 10.0  # of anything from anything [m]


@dataclass(frozen=True)
class EndEffector:
    """Frame `ee`: between the fingertips, z out of the hand, y along the fingers' motion.

    With the hand straight down at zero yaw its axes are world x, -y, -z. position [m] and quaternion (wxyz) in `body`.
    """

    body: str
    position: tuple[float, ...]
    quaternion: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)

    @classmethod
    def read(cls, what: str, tree: Any) -> Self:
        """Make it of what YAML holds; `UsageError` names what is wrong."""
        tree = _tree(what, tree, cls)
        quaternion = _numbers(f"{what}.quaternion", tree.get("quaternion", cls.quaternion), 4, 1.0)
        if np.linalg.norm(quaternion) < 0.1:
            raise ManipError(f"{what}.quaternion is {quaternion}; expected one of length 1, wxyz")
        position = _numbers(f"{what}.position", tree["position"], 3, _FURTHEST)
        return cls(checks.text(f"{what}.body", tree["body"]), position, quaternion)


@dataclass(frozen=True)
class GripperConfig:
    """The driven joints, where each stands when the gripper is closed and open, and the bodies that touch things.

    finger_mass: of every finger in place of the model's [kg].
    """

    joints: tuple[str, ...]
    closed: tuple[float, ...]
    open: tuple[float, ...]
    fingers: tuple[str, ...]
    finger_mass: float | None = None

    @classmethod
    def read(cls, what: str, tree: Any) -> Self:
        """Make it of what YAML holds; `UsageError` names what is wrong."""
        tree = _tree(what, tree, cls)
        joints, fingers = (_names(f"{what}.{name}", tree[name]) for name in ("joints", "fingers"))
        if len(fingers) < 2:
            raise ManipError(f"{what}.fingers names {len(fingers)}; expected two or more bodies")
        closed, opened = (_numbers(f"{what}.{name}", tree[name], len(joints), _FURTHEST) for name in ("closed", "open"))
        for joint, at, to in zip(joints, closed, opened, strict=True):
            if at == to:
                raise ManipError(
                    f"{what}.closed and {what}.open are both {at:g} for joint {joint!r}; expected two places"
                )
        mass = tree.get("finger_mass")
        mass = None if mass is None else checks.number(f"{what}.finger_mass", mass, 1e-6, 100)
        return cls(joints, closed, opened, fingers, mass)


@dataclass(frozen=True)
class Workspace:
    """Volume in which tasks take place: +- half_width about the centre on the table, up to a height over it [m]."""

    centre: tuple[float, ...]
    half_width: float = 0.15
    height: float = 0.45

    @classmethod
    def read(cls, what: str, tree: Any) -> Self:
        """Make it of what YAML holds; `UsageError` names what is wrong."""
        tree = _tree(what, tree, cls)
        half_width, height = (
            checks.number(f"{what}.{name}", tree.get(name, getattr(cls, name)), 0.02, 2)
            for name in ("half_width", "height")
        )
        return cls(_numbers(f"{what}.centre", tree["centre"], 2, _FURTHEST), half_width, height)


@dataclass(frozen=True)
class Robot:
    """A joint-position-controlled arm with a gripper, as its YAML says it; paths are absolute.

    joints: of the arm, base to hand. home: a posture over the workspace with the hand down [rad]. gains: kp of each
    joint [N m/rad]. includes, meshes: folders of what the model includes and of its meshes. base: of the root body
    [m]. fixed: where joints stand that are neither the arm's nor the gripper's [rad or m]. max_joint_step: the longest
    step of a joint target from the measured joint [rad]. colours: red, green and blue of meshes without contacts, by
    patterns of names, later ones first.
    """

    name: str
    model: Path
    joints: tuple[str, ...]
    home: tuple[float, ...]
    gains: tuple[float, ...]
    ee: EndEffector
    gripper: GripperConfig
    workspace: Workspace
    includes: Path | None = None
    meshes: Path | None = None
    base: tuple[float, ...] | None = None
    fixed: Mapping[str, float] = field(default_factory=dict, hash=False)
    max_joint_step: float = JOINT_STEP
    colours: Mapping[str, tuple[float, ...]] = field(default_factory=dict, hash=False)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of `observation.state` and `action`: arm joints, then the gripper."""
        return (*self.joints, "gripper")

    def content(self) -> bytes:
        """Return what identifies the robot: its fields, its model with all includes, its meshes' names and sizes."""
        places = {"model", "includes", "meshes", "colours"}
        said = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in places}
        included = sorted((self.includes or self.model.parent).glob("*.xml"))
        files = sorted((name, path.stat().st_size) for name, path in self.mesh_files().items())
        texts = [one.read_bytes() for one in (self.model, *included)]
        return b"".join([repr((said, files)).encode(), *texts])

    def mesh_files(self) -> dict[str, Path]:
        """Return the model's meshes by name: of the folder that is given, else those that the model names."""
        if self.meshes or self.includes:
            folder = self.meshes or self.model.parent
            return {str(one.relative_to(folder)): one for one in folder.rglob("*.stl")}
        spec = mujoco.MjSpec.from_file(str(self.model))
        return {mesh.file: self.model.parent / spec.meshdir / mesh.file for mesh in spec.meshes if mesh.file}

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a robot's YAML. Raises `UsageError` naming the file and what is wrong in it."""
        try:
            return cls._of(path, read_yaml(path, "a robot's YAML"))
        except ManipError as error:
            raise UsageError(str(error) if str(path) in str(error) else f"{path}: {error}") from None

    @classmethod
    def _of(cls, path: Path, tree: Any) -> Self:
        tree = _tree(str(path), tree, cls, without=("name",))
        joints = _names("joints", tree["joints"])
        gripper = GripperConfig.read("gripper", tree["gripper"])
        if both := set(joints) & set(gripper.joints):
            raise ManipError(f"joints and gripper.joints both name {min(both)!r}; expected every joint in one of them")
        base = tree.get("base")
        fixed = checks.mapping("fixed", tree.get("fixed", {}))
        colours = checks.mapping("colours", tree.get("colours", {}))
        return cls(
            name=checks.name("a robot's name", path.stem),
            model=_place("model", tree["model"], path.parent),
            joints=joints,
            home=_numbers("home", tree["home"], len(joints), 100.0),
            gains=_numbers("gains", tree["gains"], len(joints), 1e6, least=0.0),
            ee=EndEffector.read("ee", tree["ee"]),
            gripper=gripper,
            workspace=Workspace.read("workspace", tree["workspace"]),
            includes=_place("includes", tree["includes"], path.parent) if "includes" in tree else None,
            meshes=_place("meshes", tree["meshes"], path.parent) if "meshes" in tree else None,
            base=None if base is None else _numbers("base", base, 3, _FURTHEST),
            fixed={name: checks.number(f"fixed: {name}", value, -100, 100) for name, value in fixed.items()},
            max_joint_step=checks.number("max_joint_step", tree.get("max_joint_step", JOINT_STEP), 1e-3, 1.0),
            colours={name: _numbers(f"colours: {name}", value, 3, 1.0, 0.0) for name, value in colours.items()},
        )


def get_robot(name: str) -> Robot:
    """Return a robot by its name in `ROBOTS`, or of a YAML file. Raises `UnknownName`, `UsageError`."""
    if name in ROBOTS:
        return _read(ROBOTS[name])
    if name.endswith(SUFFIXES):
        return _read(Path(name).absolute())
    raise UnknownName("robot", name, ROBOTS)


_read = cache(Robot.read)


def _tree(what: str, tree: Any, kind: type, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a mapping whose keys are fields of `kind`. Raises `UnknownName` for another, `ManipError` without one."""
    found = checks.mapping(what, tree)
    known = {one.name: one for one in fields(kind) if one.name not in without}
    for key in found:
        if key not in known:
            raise UnknownName(f"key in {what}:", key, known)
    for name, one in known.items():
        if name not in found and one.default is MISSING and one.default_factory is MISSING:
            raise ManipError(f"{what} has no {name!r}; a robot's YAML needs one")
    return found


def _names(what: str, value: Any) -> tuple[str, ...]:
    names = tuple(
        checks.text(f"a name in {what}", one, checks.LONGEST_NAME) for one in checks.array(what, value, _MOST_JOINTS)
    )
    if not names or len(set(names)) < len(names):
        raise ManipError(f"{what} names {checks.shorten(names)}; expected at least one, each once")
    return names


def _numbers(what: str, value: Any, count: int, most: float, least: float | None = None) -> tuple[float, ...]:
    found = checks.array(what, value, _MOST_JOINTS)
    if len(found) != count:
        raise ManipError(f"{what} has {len(found)} numbers; expected {count}")
    return tuple(checks.number(f"a number in {what}", one, -most if least is None else least, most) for one in found)


def _place(what: str, value: Any, folder: Path) -> Path:
    """Return the path of `PATH`, from the YAML's folder, or of `PACKAGE:PATH`, in an installed package."""
    package, colon, path = checks.text(what, value).partition(":")
    if not colon:
        return folder / package
    found = importlib.util.find_spec(package) if package.isidentifier() else None
    if found is None or found.origin is None:
        raise ManipError(f"{what} is in {package!r}, which is not installed; run: pip install {package}")
    return Path(found.origin).parent / path
