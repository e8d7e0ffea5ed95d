"""The joints of an arm, from its base to its hand, and what its motors can do."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from manip_il.errors import UsageError
from manip_il.robots.files import ModelFiles
from manip_il.robots.spec import require

FORCE = 200.0  # of an arm joint whose model sets no limit [N m]
ARMATURE = 0.1  # of an arm joint whose model has none [kg m^2]


def arm_joints(robot: str, spec: mujoco.MjSpec, hand: str, gripper: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the joints that turn between the base and the hand. Raises `UsageError` where there are none.

    robot: its name, for messages. gripper: joints that are not the arm's.
    """
    require(robot, "body", (hand,), spec.bodies)
    joints: list[str] = []
    body = spec.body(hand)
    while body.name != "world":
        hinges = [one for one in body.joints if one.type == mujoco.mjtJoint.mjJNT_HINGE and one.name not in gripper]
        if nameless := [one for one in hinges if not one.name]:
            raise UsageError(
                f"robot {robot}: {len(nameless)} joint of body {body.name!r} has no name; name it in the model"
            )
        joints[:0] = [one.name for one in hinges]
        body = body.parent
    if not joints:
        raise UsageError(f"robot {robot}: no joint turns between the base and {hand!r}; expected the body of the hand")
    return tuple(joints)


def motor_limits(
    robot: str, files: ModelFiles, spec: mujoco.MjSpec, joints: Sequence[str]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the greatest torques [N m] and the armatures [kg m^2] of joints, as the model has them."""
    whole = files.load(robot)  # held: what MuJoCo gives of a model does not keep it
    motors = {one.target: one for one in whole.actuators}
    forces = [_greatest_torque(motors.get(name), spec.joint(name)) for name in joints]
    armature = [float(spec.joint(name).armature) or ARMATURE for name in joints]
    return tuple(forces), tuple(armature)


def _greatest_torque(motor: mujoco._specs.MjsActuator | None, joint: mujoco._specs.MjsJoint) -> float:
    limits = [tuple(joint.actfrcrange)]
    if motor is not None:
        gear = abs(float(motor.gear[0])) or 1.0
        limits.append(tuple(gear * float(end) for end in motor.forcerange))
        if motor.biastype == mujoco.mjtBias.mjBIAS_NONE and motor.gaintype == mujoco.mjtGain.mjGAIN_FIXED:
            gain = gear * abs(float(motor.gainprm[0]))
            limits.append(tuple(gain * float(end) for end in motor.ctrlrange))
    greatest = [min(-low, high) for low, high in limits if low < 0 < high]
    return float(min(greatest, default=FORCE))
