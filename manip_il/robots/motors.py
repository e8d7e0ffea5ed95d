"""Position control of every joint, in place of a model's own motors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from manip_il.robots.robot import Robot

PLAIN = mujoco.MjSpec()  # its defaults are for what we add to a model, whose own may name a material or a range
_KV_PER_KP = 1 / 20  # [s]: a time constant of one control step at 20 Hz
_DAMPING = 1.0  # of an arm joint [N m s/rad]
_FINGER_GAINS = (800.0, 20.0, 40.0)  # kp [N/m], kv [N s/m], force [N] of a sliding finger
_HINGE_GAINS = (20.0, 0.5, 10.0)  # kp [N m/rad], kv [N m s/rad], torque [N m] of a turning one
_FINGER_ARMATURE, _FINGER_DAMPING = 0.2, 10.0  # [kg], [N s/m]
_LINK_ARMATURE, _LINK_DAMPING = 0.001, 0.02  # of a linkage's joint [kg m^2], [N m s/rad]
_HINGE_ARMATURE, _HINGE_DAMPING = 0.005, 0.1  # [kg m^2], [N m s/rad]


def motorise(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Give the joints of arm and gripper position control in place of the model's motors."""
    for name, kp, force, armature in zip(robot.joints, robot.gains, robot.forces, robot.armature, strict=True):
        joint = spec.joint(name)
        joint.damping, joint.stiffness, joint.armature = np.array([_DAMPING, 0, 0]), np.zeros(3), armature
        joint.frictionloss = 0.0  # a servo's own control overcomes it
        _position_actuator(spec, joint, (kp, kp * _KV_PER_KP, force))
    for name, ends in zip(
        robot.gripper.joints, zip(robot.gripper.closed, robot.gripper.open, strict=True), strict=True
    ):
        joint = spec.joint(name)
        if joint.range[0] >= joint.range[1]:  # a linkage that runs past its end folds over
            joint.range = sorted(ends)
        slides = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
        joint.damping = np.array([_FINGER_DAMPING if slides else _HINGE_DAMPING, 0, 0])
        joint.armature = _FINGER_ARMATURE if slides else _HINGE_ARMATURE
        joint.frictionloss = 0.0
        kp, kv, force = _FINGER_GAINS if slides else _HINGE_GAINS
        _position_actuator(spec, joint, (kp, kv, robot.gripper.force or force))


def calm(spec: mujoco.MjSpec, linked: Sequence[str]) -> None:
    """Give the joints of a linkage that nothing drives the little inertia and damping that keep them from ringing."""
    for name in linked:
        joint = spec.joint(name)
        joint.armature = max(joint.armature, _LINK_ARMATURE)
        joint.damping = np.maximum(joint.damping, [_LINK_DAMPING, 0, 0])


def _position_actuator(spec: mujoco.MjSpec, joint: Any, gains: tuple[float, float, float]) -> None:
    """PD position control of one joint: force = kp (ctrl - q) - kv v, within +-force [N or N m]."""
    kp, kv, force = gains
    actuator = spec.add_actuator(PLAIN.default, name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=kp, kv=kv)
    actuator.forcelimited, actuator.forcerange = True, [-force, force]
    if joint.range[0] < joint.range[1]:
        actuator.ctrllimited, actuator.ctrlrange = True, joint.range
