"""A robot's model as a spec of its own: motorised, with the site `ee`, and nothing that belongs to a world."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from manip_il.errors import UnknownName, UsageError
from manip_il.robots.robot import Robot

_KV_PER_KP = 1 / 20  # [s]: a time constant of one control step at 20 Hz
_FORCE = 200.0  # of an arm joint [N m]
_ARMATURE, _DAMPING = 0.1, 1.0  # of an arm joint [kg m^2], [N m s/rad]
_FINGER_GAINS = (800.0, 20.0, 40.0)  # kp [N/m], kv [N s/m], force [N] of a sliding finger
_HINGE_GAINS = (20.0, 0.5, 10.0)  # kp [N m/rad], kv [N m s/rad], torque [N m] of a turning one
_FINGER_ARMATURE, _FINGER_DAMPING = 0.2, 10.0  # [kg], [N s/m]
_HINGE_ARMATURE, _HINGE_DAMPING = 0.005, 0.1  # [kg m^2], [N m s/rad]


def arm_spec(robot: Robot) -> mujoco.MjSpec:
    """Return the arm as a spec: position-controlled, with the site `ee`, and nothing that is not the robot's.

    Raises `UsageError` naming a joint, body or file that is not there, and what is.
    """
    spec = _load(robot)
    _require(robot, "joint", (*robot.joints, *robot.gripper.joints), spec.joints)
    _require(robot, "body", (robot.ee.body, *robot.gripper.fingers), spec.bodies)
    _strip(spec)
    _fix_joints(robot, spec)
    _motorise(robot, spec)
    ee = robot.ee
    spec.body(ee.body).add_site(name="ee", pos=ee.position, quat=ee.quaternion, size=[0.004] * 3, group=4)
    for body in spec.bodies:
        body.gravcomp = 1.0
    for finger in robot.gripper.fingers if robot.gripper.finger_mass else ():
        body = spec.body(finger)
        body.mass, body.inertia = robot.gripper.finger_mass, np.full(3, 1e-4)
    _paint(robot, spec)
    return spec


def arm_model(robot: Robot) -> mujoco.MjModel:
    """Compile the arm alone, fingers fixed: what inverse kinematics works on."""
    spec = arm_spec(robot)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for name in robot.gripper.joints:
        spec.delete(spec.joint(name))
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    return spec.compile()


def _require(robot: Robot, kind: str, names: Sequence[str], there: Sequence[Any]) -> None:
    known = [one.name for one in there if one.name != "world"]
    for name in names:
        if name not in known:
            raise UnknownName(f"{kind} in the YAML of robot {robot.name}:", name, known)


def _load(robot: Robot) -> mujoco.MjSpec:
    """Read the model with its includes and meshes. Raises `UsageError` where MuJoCo cannot."""
    try:
        text = robot.model.read_text()
        if robot.includes is None and robot.meshes is None:
            return mujoco.MjSpec.from_file(str(robot.model))
        include = {one.name: one.read_bytes() for one in sorted((robot.includes or robot.model.parent).glob("*.xml"))}
        assets = {name: one.read_bytes() for name, one in robot.mesh_files().items()}
        spec = mujoco.MjSpec.from_string(text, include=include, assets=assets)
    except (OSError, ValueError) as error:
        raise UsageError(f"robot {robot.name}: cannot read {robot.model}: {' '.join(str(error).split())}") from None
    spec.meshdir = ""
    return spec


def _fix_joints(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Delete joints that are neither the arm's nor the gripper's, their bodies left where the YAML says."""
    kept = {*robot.joints, *robot.gripper.joints}
    known = {joint.name for joint in spec.joints} - kept
    for name in robot.fixed:
        if name not in known:
            raise UnknownName(f"joint in 'fixed' of robot {robot.name}:", name, known)
    for joint in [joint for joint in spec.joints if joint.name not in kept]:
        _stand_at(joint, robot.fixed.get(joint.name, 0.0))
        spec.delete(joint)
    if robot.base is not None:
        root = spec.body(robot.ee.body)
        while root.parent.name != "world":
            root = root.parent
        root.pos = np.array(robot.base)


def _stand_at(joint: Any, value: float) -> None:
    """Move a joint's body to where the joint is at `value` [rad or m]."""
    body, axis = joint.parent, np.asarray(joint.axis, dtype=np.float64)
    quat, turned = np.asarray(body.quat, dtype=np.float64), np.empty(3)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        mujoco.mju_rotVecQuat(turned, axis * value, quat)
        body.pos = np.asarray(body.pos) + turned
    elif value:
        turn, both = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, axis, value)
        mujoco.mju_mulQuat(both, quat, turn)
        body.quat = both


def _strip(spec: mujoco.MjSpec) -> None:
    """Delete what a model brings for a world of its own: motors, mocap bodies, sky, views, gravity and time."""
    for one in _foreign(spec):
        spec.delete(one)
    plain = mujoco.MjSpec().option
    for name in [name for name in dir(plain) if not name.startswith("_")]:
        setattr(spec.option, name, getattr(plain, name))
    for name in [name for name in dir(spec) if name.startswith("nuser_")]:
        setattr(spec, name, -1)


def _foreign(spec: mujoco.MjSpec) -> Iterator[Any]:
    """Yield what is to be deleted, looked up again after every kind: MuJoCo deletes what hangs on the deleted too."""
    yield from list(spec.keys)
    mocaps = {body.name for body in spec.bodies if body.mocap}
    yield from [equality for equality in spec.equalities if {equality.name1, equality.name2} & mocaps]
    yield from [body for body in spec.bodies if body.mocap]
    used = {name for material in spec.materials for name in material.textures}
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    yield from [texture for texture in spec.textures if texture.type == sky or texture.name not in used]
    for kind in ("actuators", "sensors", "cameras", "lights", "sites"):
        yield from list(getattr(spec, kind))


def _motorise(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Give every joint position control in place of the model's motors."""
    for name, kp in zip(robot.joints, robot.gains, strict=True):
        joint = spec.joint(name)
        joint.damping, joint.stiffness, joint.armature = np.array([_DAMPING, 0, 0]), np.zeros(3), _ARMATURE
        _position_actuator(spec, joint, (kp, kp * _KV_PER_KP, _FORCE))
    for name in robot.gripper.joints:
        joint = spec.joint(name)
        slides = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
        joint.damping = np.array([_FINGER_DAMPING if slides else _HINGE_DAMPING, 0, 0])
        joint.armature = _FINGER_ARMATURE if slides else _HINGE_ARMATURE
        _position_actuator(spec, joint, _FINGER_GAINS if slides else _HINGE_GAINS)


def _position_actuator(spec: mujoco.MjSpec, joint: Any, gains: tuple[float, float, float]) -> None:
    """PD position control of one joint: force = kp (ctrl - q) - kv v, within +-force [N or N m]."""
    kp, kv, force = gains
    actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=kp, kv=kv)
    actuator.forcelimited, actuator.forcerange = True, [-force, force]
    if joint.range[0] < joint.range[1]:
        actuator.ctrllimited, actuator.ctrlrange = True, joint.range


def _paint(robot: Robot, spec: mujoco.MjSpec) -> None:
    for geom in spec.geoms:
        for pattern, colour in reversed(list(robot.colours.items())):
            if geom.meshname and fnmatch.fnmatch(geom.meshname, pattern) and not (geom.contype or geom.conaffinity):
                geom.rgba = np.array([*colour, 1.0])
                break
