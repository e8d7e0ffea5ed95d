"""Robots by name, and their YAML, checked; what the YAML does not say is found on the model."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.checks import read_yaml
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.robots import ROBOTS
from manip_il.robots.files import KEYS, ModelFiles
from manip_il.robots.parts import CameraPose, Costs, EndEffector, GripperConfig, Table, Workspace
from manip_il.robots.reading import FURTHEST, missing, names, numbers, tree_of
from manip_il.robots.robot import FOUND, JOINT_STEP, UPRIGHT, YAWS, Robot, costs_of, yaw_of
from manip_il.robots.servos import LeRobotConfig

SUFFIXES = (".yaml", ".yml")
SCENE_CAMERAS = ("front", "side")  # that a YAML may place
GROUP = "manip_il.robots"  # of entry points: a name, and the path of a YAML


def get_robot(name: str) -> Robot:
    """Return a robot by its name, of a YAML file, or that a package brings. Raises `UnknownName`, `UsageError`."""
    if name in ROBOTS:
        return _read(ROBOTS[name])
    if name.endswith(SUFFIXES):
        return _read(Path(name).absolute())
    for found in entry_points(group=GROUP, name=name):
        try:
            path = Path(found.load())
        except Exception as error:
            why = checks.one_line(error)
            raise UsageError(f"robot {name} of {found.value}: {why}; expected the path of a YAML") from error
        return _read(path.absolute())
    raise UnknownName("robot", name, ROBOTS, f"known: {', '.join(sorted(ROBOTS))}, or the path of a YAML")


def is_robot(name: str) -> bool:
    """Return whether a robot ships, or an installed package brings it."""
    return name in ROBOTS or bool(entry_points(group=GROUP, name=name))


def read_robot(path: Path) -> Robot:
    """Read a robot's YAML. Raises `UsageError` naming the file and what is wrong in it."""
    said: dict[str, Any] = {}
    try:
        said = _said(path, read_yaml(path, "a robot's YAML"))
        lacking = [name for name in FOUND if name not in said]
        if lacking:
            from manip_il.robots.found import complete  # here, as what ships says it all, and mink takes long

            said = complete(said)
        return Robot(**said)
    except ValueError as error:  # MuJoCo's, of a model that it reads and does not compile
        why = " ".join(str(error).split())
        what = "a name is not UTF-8 in" if isinstance(error, UnicodeDecodeError) else "MuJoCo cannot compile"
        raise UsageError(f"{path}: {what} {said['files'].model}: {why}") from None
    except ManipError as error:
        named = str(path) in str(error) or f"robot {path.stem}" in str(error)
        raise UsageError(str(error) if named else f"{path}: {error}") from None


def _said(path: Path, tree: Any) -> dict[str, Any]:
    """The fields that a YAML says, and the defaults of those that are not found on the model."""
    tree = tree_of(str(path), tree, Robot, without=("name", "files", "hand", *FOUND), more=(*KEYS, "hand", *FOUND))
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
    cameras = checks.mapping("cameras", tree.get("cameras", {}))
    if unknown := [name for name in cameras if name not in SCENE_CAMERAS]:
        raise UnknownName("camera in a robot's YAML:", unknown[0], SCENE_CAMERAS)
    said["cameras"] = {name: CameraPose.read(f"cameras.{name}", one) for name, one in cameras.items()}
    if "table" in tree:
        said["table"] = Table.read("table", tree["table"], said["workspace"])
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


_read = cache(read_robot)
