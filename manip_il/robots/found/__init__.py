"""Finds on a robot's model what its YAML need not say: joints, motors, the hand's frame, a posture to start from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from manip_il.robots.found.chain import arm_joints, motor_limits
from manip_il.robots.found.gains import find_gains
from manip_il.robots.found.hand import find_ee
from manip_il.robots.found.home import find_home
from manip_il.robots.parts import EndEffector
from manip_il.robots.robot import Robot, costs_of, yaw_of
from manip_il.robots.spec import bare_spec, require


def complete(said: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a YAML says and, for the rest, what its model shows. Raises `UsageError` where it shows nothing."""
    said = dict(said)
    spec = bare_spec(said["name"], said["files"], said["hand"], said["gripper"])
    joints = said.setdefault("joints", arm_joints(said["name"], spec, said["hand"], said["gripper"].joints))
    require(said["name"], "joint", joints, spec.joints)
    said.setdefault("costs", costs_of(len(joints)))
    said.setdefault("yaw", yaw_of(len(joints)))
    forces, armature = motor_limits(said["name"], said["files"], spec, joints)
    said.setdefault("forces", forces)
    said.setdefault("armature", armature)
    lacking = [name for name in ("ee", "home", "gains") if name not in said]
    provisional: dict[str, Any] = {
        "ee": EndEffector(said["hand"], (0.0, 0.0, 0.0)),
        "home": (0.0,) * len(joints),
        "gains": (1.0,) * len(joints),
    }
    robot = Robot(**(provisional | said))
    if "ee" in lacking:
        robot = replace(robot, ee=find_ee(robot))
    if "home" in lacking:
        robot = find_home(robot, turns="ee" in lacking)
    if "gains" in lacking:
        robot = replace(robot, gains=find_gains(robot))
    return said | {name: getattr(robot, name) for name in ("ee", "home", "gains")}
