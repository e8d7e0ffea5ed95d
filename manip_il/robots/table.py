"""Robots by name, from their YAML; what the YAML omits is found in the model."""

import typing
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.checks import read_yaml
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.option import NameOrPath
from manip_il.robots import ROBOTS
from manip_il.robots.robot import (
    FOUND,
    GRIPPER,
    KEYS,
    WRIST,
    GripperConfig,
    ModelFiles,
    Robot,
    place,
    read,
)
from manip_il.robots.servos import servos_of
from manip_il.robots.spec import arm_joints

PLACED = ("front", "side", WRIST)  # cameras that a YAML may place
EXTENDS = "extends"  # key of the robot whose values a YAML changes


def get_robot(name: NameOrPath) -> Robot:
    """Return a robot.

    Args:
        name: Its name, or the `Path` of a YAML that the user gave.

    Raises:
        UnknownName: If there is no robot of this name.
        UsageError: If its YAML is invalid.
    """
    if isinstance(name, Path):
        return _read(name.absolute())
    if name in ROBOTS:
        return _read(ROBOTS[name])
    raise UnknownName("robot", name, (*ROBOTS, "the path of a YAML or of a world's Python file"))


def read_robot(path: Path) -> Robot:
    """Read a robot's YAML.

    Args:
        path: Path of the YAML.

    Raises:
        UsageError: If something in it is wrong; the message names the file and what is wrong.
    """
    try:
        if path.stem in ROBOTS and path.resolve() != ROBOTS[path.stem].resolve():
            raise ManipError(f"a built-in robot is called {path.stem}; rename the file")
        said = _said(path, read_yaml(path, "a robot's YAML"))
        if EXTENDS in said:
            base = said.pop(EXTENDS)
            return replace(base, **said | {"cameras": {**base.cameras, **said.get("cameras", {})}})
        if all(name in said for name in FOUND):
            return Robot(**said)
        # imported here: mink is slow, and a shipped YAML is complete
        from manip_il.robots.found import complete

        return complete(said)
    except ValueError as error:  # MuJoCo's, for a model that it reads but cannot compile
        raise UsageError(
            f"{path}: MuJoCo cannot compile its model: {checks.one_line(error)}"
        ) from None
    except ManipError as error:
        named = str(path) in str(error) or f"robot {path.stem}" in str(error)
        raise UsageError(str(error) if named else f"{path}: {error}") from None


def _base(name: Any, path: Path) -> Robot:
    """Return the robot that a YAML extends."""
    if checks.text(EXTENDS, name) in ROBOTS:
        return get_robot(name)
    base = place(EXTENDS, name, path.parent)
    if base.resolve() == path.resolve():
        raise ManipError(f"{path} extends itself")
    return get_robot(base)


def _said(path: Path, tree: Any) -> dict[str, Any]:
    """The fields that a YAML gives, and the arm's joints or the robot that is extended."""
    tree, kinds = dict(checks.mapping(str(path), tree)), typing.get_type_hints(Robot)
    own = [name for name in kinds if name not in ("name", "files", "gripper")]
    known = (EXTENDS, *own) if EXTENDS in tree else (*KEYS, "gripper", *own)
    for key, value in tree.items():
        if key not in known:
            raise UnknownName(f"key in {path}:", key, known)
        checks.finite(key, value)
    if "hand" not in tree and "ee" in tree:
        tree["hand"] = checks.mapping("ee", tree["ee"]).get("body")
    said: dict[str, Any] = {"name": checks.name("a robot's name", path.stem)}
    if EXTENDS in tree:
        said[EXTENDS] = base = _base(tree.pop(EXTENDS), path)
        if isinstance(named := tree.get("servos"), str):
            tree["servos"] = servos_of(named, base.joint_names)
    else:
        for name in ("model", "hand", "gripper", "workspace"):
            if name not in tree:
                raise ManipError(f"{path} has no {name!r}; a robot's YAML needs one")
        said["files"] = ModelFiles.read("", tree, path.parent)
        said["gripper"] = _gripper(checks.mapping("gripper", tree["gripper"]), path.parent)
    for camera in checks.mapping("cameras", tree.get("cameras", {})):
        if camera not in PLACED:
            raise UnknownName("camera in a robot's YAML:", camera, PLACED)
    said |= {
        key: read(key, kinds[key], value)
        for key, value in tree.items()
        if key not in (*KEYS, "gripper")
    }
    if EXTENDS not in said and "joints" not in said:
        said["joints"] = arm_joints(said["name"], said["files"], said["hand"], said["gripper"])
    return said


def _gripper(tree: Mapping[str, Any], folder: Path) -> GripperConfig:
    """Read a gripper; if it has a model of its own, its names get the prefix `gripper/`."""
    own = {key: value for key, value in tree.items() if key not in KEYS}
    gripper: GripperConfig = read("gripper", GripperConfig, own)
    if "model" not in tree:
        return gripper
    names = {
        key: tuple(GRIPPER + name for name in getattr(gripper, key))
        for key in ("joints", "fingers")
    }
    return replace(gripper, files=ModelFiles.read("gripper.", tree, folder), **names)


_read = cache(read_robot)
