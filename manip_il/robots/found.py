"""Find in a robot's model what its YAML may omit: gains and limits of motors, the hand's frame,
the home posture.
"""

import itertools
import math
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.robots.geometry import Body, at_tip, hand_down, nearest, outline, rotation_vector
from manip_il.robots.gripper import finger_geoms, set_time_step
from manip_il.robots.ik import ArmIK
from manip_il.robots.robot import EndEffector, Robot
from manip_il.robots.spec import arm_model, arm_spec, bare_spec, require

FORCE = 200.0  # torque limit of an arm joint whose model sets none [N m]
ARMATURE = 0.1  # armature of an arm joint whose model has none [kg m^2]
FREQUENCY = 2 * math.pi * 6.0  # natural frequency of a joint with its motor as a spring [rad/s]
# share of the way from closed to open at which `ee` is found: about as open as around an object
_AT_OBJECT = 0.7
_SETTLE = 1000  # physics steps
FROM_TIP = 0.012  # distance of the frame `ee` from the fingertips [m]
_CLEAR = 0.006  # clearance of the fingertips over the table with `ee` at its lowest [m]
# cosine of the largest angle from a body axis at which the fingers' motion counts as parallel to it
_SQUARE = 0.95
_LEAST_GAP = 1e-4  # least gap between the fingers at `_AT_OBJECT` [m]
_METRES, _TURN = 4, 6  # decimals of positions [m] and of quaternions
_STARTS, _STEPS = 40, 150  # inverse kinematics: number of random postures, and of steps from each
_LONGEST = 0.2  # longest step of a joint [rad]
# height of the hand over the table, or half the workspace's height if that is less [m]
_HIGHEST = 0.2
# a root body nearer than this to where it would stand best needs no other `base` [m]
_ON_PLACE = 0.05
_LOWER = (1.0, 0.7, 0.4)  # shares of that height, tried in order
_ARRIVED = 0.01  # tolerated pose error [m], a radian counting as 5 cm
_ANGLE_AS_LENGTH = 0.05
# sufficient margin to a limit [rad], smallest singular value, height of the links [m]
_ENOUGH = (0.5, 0.15, 0.25)
_DIGITS = 4  # decimals of a posture [rad]


def complete(said: dict[str, Any]) -> Robot:
    """Complete a YAML's fields from the robot's model, and return the robot.

    Args:
        said: The fields of `Robot` that the YAML gives.

    Raises:
        UsageError: If a field cannot be found in the model.
    """
    name, names = said["name"], said["joints"]
    spec = bare_spec(name, said["files"], said["hand"], said["gripper"])
    require(name, "joint", names, spec.joints)
    joints = [spec.joint(joint) for joint in names]
    # keep a reference: MuJoCo's views of a spec do not keep it alive
    whole = said["files"].load(name)
    motors = {motor.target: motor for motor in whole.actuators}
    found: dict[str, Any] = {
        "forces": tuple(_greatest_torque(motors.get(joint.name), joint) for joint in joints),
        "armature": tuple(float(joint.armature) or ARMATURE for joint in joints),
        # provisional, replaced below:
        "ee": EndEffector(said["hand"], (0.0, 0.0, 0.0)),
        "home": (0.0,) * len(joints),
        "gains": (1.0,) * len(joints),
    }
    robot = Robot(**found | said)
    if "ee" not in said:
        robot = replace(robot, ee=find_ee(robot))
    if "home" not in said:
        robot = find_home(robot, turns="ee" not in said)
    return robot if "gains" in said else replace(robot, gains=find_gains(robot))


def _greatest_torque(motor: Any, joint: Any) -> float:
    limits = [joint.actfrcrange]
    if motor is not None:
        gear = abs(float(motor.gear[0])) or 1.0
        limits.append(gear * motor.forcerange)
        if (
            motor.biastype == mujoco.mjtBias.mjBIAS_NONE
            and motor.gaintype == mujoco.mjtGain.mjGAIN_FIXED
        ):
            limits.append(gear * abs(float(motor.gainprm[0])) * motor.ctrlrange)
    return float(min((min(-low, high) for low, high in limits if low < 0 < high), default=FORCE))


def find_gains(robot: Robot) -> tuple[float, ...]:
    """Return each joint's kp [N m/rad] for a natural frequency of 6 Hz at home.

    With the joint's inertia I [kg m^2] in the home posture, kp = (2 pi 6 Hz)^2 I.
    """
    model = arm_spec(robot).compile()
    data = mujoco.MjData(model)
    for name, value in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    dofs = [model.joint(name).dofadr[0] for name in robot.joints]
    return tuple(float(f"{FREQUENCY**2 * inertia[dof, dof]:.3g}") for dof in dofs)


def find_ee(robot: Robot) -> EndEffector:
    """Return the frame between the fingertips.

    Its z points from the hand to the fingertips, and its y along the fingers' motion. z is snapped
    to the nearest axis of the hand's body; y, too, if it is nearly parallel to one.

    Raises:
        UsageError: If the fingers do not come apart.
    """
    model, data = _settled(robot, _AT_OBJECT)
    hand = data.body(robot.hand)
    axes = hand.xmat.reshape(3, 3)
    fingers = finger_geoms(model, robot.gripper.fingers)
    middle = np.mean([data.geom_xpos[geom] for finger in fingers for geom in finger], axis=0)
    z = _along_axis(axes.T @ (middle - hand.xpos))
    points = _finger_points(robot, model, data)
    pads, ends = nearest(model, data, [at_tip(model, data, finger, axes @ z) for finger in fingers])
    one, other = (ends - hand.xpos) @ axes
    way = other - one - z * (z @ (other - one))
    if np.linalg.norm(way) < _LEAST_GAP:
        raise UsageError(
            f"robot {robot.name}: the fingers do not open; check gripper.fingers and gripper.open"
        )
    y = _along_axis(way / np.linalg.norm(way), _SQUARE)
    x = np.cross(y, z)
    low, high = (
        max((points[pad] @ x).min() for pad in pads),
        min((points[pad] @ x).max() for pad in pads),
    )
    tip, closed_tip = (
        max(float((around @ z).max()) for around in found.values())
        for found in (points, _finger_points(robot, *_settled(robot, 0.0)))
    )
    position = x * (low + high) / 2 + y * (y @ (one + other)) / 2 + z * (tip - FROM_TIP)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([x, y, z], axis=1).ravel())
    lowest = round(FROM_TIP + max(0.0, closed_tip - tip) + _CLEAR, _METRES)
    return EndEffector(robot.hand, _rounded(position, _METRES), _rounded(quaternion, _TURN), lowest)


def _settled(robot: Robot, share: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Compile the robot and let its fingers settle at a share of the way from closed to open.

    The arm stays still.
    """
    alone = replace(robot, joints=(), home=(), gains=(), forces=(), armature=(), lerobot=None)
    spec = arm_spec(alone)
    set_time_step(spec)
    model = spec.compile()
    data, config = mujoco.MjData(model), robot.gripper
    for name, closed, opened in zip(config.joints, config.closed, config.open, strict=True):
        data.joint(name).qpos[0] = data.actuator(name).ctrl[0] = closed + share * (opened - closed)
    mujoco.mj_step(model, data, _SETTLE)
    mujoco.mj_kinematics(model, data)
    return model, data


def _finger_points(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, F64]:
    """Points around every geom of the fingers, by its id, in the hand's frame, (n, 3) [m]."""
    hand = data.body(robot.hand)
    geoms = itertools.chain(*finger_geoms(model, robot.gripper.fingers))
    return {
        geom: (outline(model, data, geom) - hand.xpos) @ hand.xmat.reshape(3, 3) for geom in geoms
    }


def _along_axis(vector: F64, least: float = 0.0) -> F64:
    """The unit vector (3,) of the axis nearest to `vector`.

    `vector` itself if its component there is below `least`.
    """
    axis = int(np.argmax(np.abs(vector)))
    if abs(float(vector[axis])) < least:
        return vector
    unit = np.zeros(3)
    unit[axis] = np.sign(vector[axis])
    return unit


def find_home(robot: Robot, turns: bool) -> Robot:
    """Return the robot with `home` set to its best posture.

    In that posture the hand points down over the workspace's middle.

    Args:
        robot: The robot.
        turns: Whether `ee` may be turned by half a turn about z if that suits the arm better.

    Raises:
        UsageError: If inverse kinematics converges from none of forty random postures.
    """
    halves, turned = [robot], np.empty(4)
    if turns:
        mujoco.mju_mulQuat(turned, np.array(robot.ee.quaternion), np.eye(4)[3])
        halves.append(replace(robot, ee=replace(robot.ee, quaternion=_rounded(turned, _TURN))))
    highest = min(_HIGHEST, robot.workspace.height / 2)
    for share in _LOWER:
        worth, found = max(
            (_best(half, highest * share) for half in halves), key=lambda rated: rated[0]
        )
        if math.isfinite(worth):
            return found
    x, y = robot.workspace.centre
    mount = " gripper.quaternion (how the gripper is mounted)," if robot.gripper.files else ""
    raise UsageError(
        f"robot {robot.name}: the hand cannot point down over the workspace's centre ({x:g},"
        f" {y:g}); check workspace.centre,{mount} hand and base, or set home{_stance(robot)}"
    )


def _stance(robot: Robot) -> str:
    """Propose the `base` on the table from which an arm whose model stands high or turned faces
    the workspace.
    """
    model, ahead = arm_model(robot), np.zeros(3)
    mujoco.mju_rotVecQuat(ahead, np.eye(3)[0], model.body_quat[1])
    root, centre = model.body_pos[1], np.array([*robot.workspace.centre, 0.0])
    base = centre - np.linalg.norm((centre - root)[:2]) * ahead * [1, 1, 0]
    if np.allclose(base, root, atol=_ON_PLACE):
        return ""
    stands = f"the model's root stands at {_rounded(root, 2)} and faces {_rounded(ahead, 2)}"
    return f"; {stands}: try base: {list(_rounded(base, 2))}"


def _rounded(values: F64, digits: int) -> Any:
    return tuple(round(float(value), digits) for value in values)


def _best(robot: Robot, height: float) -> tuple[float, Robot]:
    """The best posture's rating, minus infinity if there is none, and the robot with that
    posture as `home`.
    """
    own = ArmIK(robot).limits
    # of a joint without limits or with a range of a turn or more: a turn
    limits = np.where(np.ptp(own, axis=1, keepdims=True) < 2 * np.pi - 1e-3, own, [-np.pi, np.pi])
    middle = replace(robot, home=tuple(limits.mean(axis=1)))
    ik, body = ArmIK(middle), Body(middle)
    rng = np.random.default_rng(0)
    best = -math.inf, robot
    target = np.array([*robot.workspace.centre, height])
    rotation = hand_down(ik.ahead(target))
    for _ in range(_STARTS):
        q, miss = _descend(ik, rng.uniform(*limits.T), target, rotation, robot.leans)
        q = np.where(limits[:, 0] == -np.pi, (q + np.pi) % (2 * np.pi) - np.pi, q)
        q = np.clip(q, *own.T)
        if miss < _ARRIVED:
            margin = float(np.minimum(q - limits[:, 0], limits[:, 1] - q).min())
            parts = np.array([margin, ik.smallest_singular_value(q), ik.lowest_link(q)])
            worth = float(np.minimum(1.0, parts / _ENOUGH).sum()) - len(body.meeting(q))
            if worth > best[0]:
                best = worth, replace(robot, home=_rounded(q, _DIGITS))
    return best


def _descend(ik: ArmIK, q: F64, target: F64, rotation: F64, soft: bool) -> tuple[F64, float]:
    """Joints that inverse kinematics reaches from `q`, and the pose error left [m]."""
    miss = math.inf
    for _ in range(_STEPS):
        position, turned = ik.ee_pose(q)
        off = rotation_vector(rotation @ turned.T)
        angle = abs(float(off[2])) if soft else float(np.linalg.norm(off))
        miss = float(np.linalg.norm(target - position)) + _ANGLE_AS_LENGTH * angle
        dq = ik.displacement(target, rotation, _LONGEST)
        if dq is None or np.abs(dq).max() < 1e-4:
            break
        q = q + dq
    return q, miss
