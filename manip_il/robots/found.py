"""Find in a robot's model what its YAML may omit: gains and limits of motors, the hand's frame,
the home posture.

And draft a YAML for a model: the hand's body, the joints that drive the fingers, and a workspace.
"""

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from manip_il.checks import one_line
from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.robots.geometry import Body, at_tip, hand_down, nearest, outline, rotation_vector
from manip_il.robots.gripper import finger_geoms, set_time_step
from manip_il.robots.ik import ArmIK
from manip_il.robots.robot import EndEffector, ModelFiles, Robot
from manip_il.robots.spec import arm_model, arm_spec, bare_spec, joint_range, load, require

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
            parts = np.array([margin, *ik.freedom(q)])
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


_ARM_GOES_ON = 3  # a branch with this many joints in series belongs to the arm: a finger has fewer
_JAWS = ("jaw", "finger", "grip", "claw")  # words in the name of a single jaw's body or joint
# words in the name of a gripper's mount
_HANDS = ("hand", "flange", "attachment", "tool", "gripper", "ee", "tcp")
# distance of the workspace's centre from the base, and its half width, in arm lengths
_REACHES, _HALF = 0.5, 0.18
_MOST_WIDE, _MOST_HIGH = 0.15, 0.45  # largest half width and height of a workspace [m]
_YAML = """\
# A first draft, derived from the model (docs/robots.md). Review it:
# manip-il view --robot.type=THIS_FILE
model: {model}
hand: {hand} # body that carries the gripper
gripper:{own}
  joints: {joints} # joints that drive the fingers
  closed: {closed} # their positions when closed, [m] if they slide, [rad] if they turn
  open: {open}
  fingers: {fingers} # bodies that touch objects
workspace:
  centre: {centre} # on the table, x away from the base [m]
  half_width: {half_width}
  height: {height}
"""


def suggest(model: Path, gripper: Path | None = None) -> dict[str, Any]:
    """Draft the content of a YAML, without paths, from a robot's MJCF.

    Args:
        model: Path of the robot's MJCF.
        gripper: Path of the gripper's MJCF, if it has one of its own.

    Returns:
        The keys `hand`, `gripper` and `workspace` with their values.

    Raises:
        UsageError: If MuJoCo cannot read or compile a file, or if no hand or no fingers are found.
    """
    last = gripper or model
    spec, with_jaws = (load(ModelFiles(path.absolute()), model.stem) for path in (model, last))
    palm, jaws = _palm(with_jaws, last)
    hand = palm if gripper is None else _flange(spec.worldbody)
    driven = _driven(with_jaws, jaws, last)
    try:
        fingers = _ends(with_jaws, palm, jaws, driven)
        return {
            "hand": hand.name,
            "gripper": fingers,
            "workspace": _workspace(spec.compile(), hand.name),
        }
    except ValueError as error:
        raise UsageError(f"MuJoCo cannot compile {last}: {one_line(error)}") from None


def _depth(body: Any) -> int:
    """Largest number of joints in series from a body outwards."""
    return len(body.joints) + max((_depth(child) for child in body.bodies), default=0)


def _palm(spec: mujoco.MjSpec, path: Path) -> tuple[Any, list[Any]]:
    """The body at which the chain of joints branches into fingers, and the first body of each.

    One jaw is enough.
    """
    body = spec.worldbody
    while moving := [child for child in body.bodies if _depth(child)]:
        longest = max(moving, key=_depth)
        if len(moving) > 1 and _depth(longest) < _ARM_GOES_ON:
            return body, moving
        body = longest
    if body.joints and any(word in f"{body.name} {body.joints[0].name}".lower() for word in _JAWS):
        return body.parent, [body]
    raise UsageError(
        f"{path}: its joints do not branch into fingers, and its last body, {body.name!r}, is not"
        " named like a jaw; if the gripper has a model of its own, give it with --gripper=PATH"
    )


def _flange(body: Any) -> Any:
    """The body that a gripper is mounted on: the last of the chain, or one fixed to it with a
    name in `_HANDS`.
    """
    while moving := [child for child in body.bodies if _depth(child)]:
        body = max(moving, key=_depth)
    named = [
        part for part in body.find_all("body") if any(word in part.name.lower() for word in _HANDS)
    ]
    return named[-1] if named else body


def _driven(spec: mujoco.MjSpec, jaws: Sequence[Any], path: Path) -> list[Any]:
    """The finger joints to drive: those that slide, else those with motors, else those next to
    the hand.
    """
    joints = [joint for jaw in jaws for joint in jaw.find_all("joint")]
    slides = [joint for joint in joints if joint.type == mujoco.mjtJoint.mjJNT_SLIDE]
    motors = {motor.target for motor in spec.actuators}
    motored = [joint for joint in joints if joint.name in motors]
    most = max((_depth(jaw) for jaw in jaws), default=0)
    next_to_hand = [jaw.joints[0] for jaw in jaws if jaw.joints and _depth(jaw) == most]
    coupled = {name for equality in spec.equalities for name in (equality.name1, equality.name2)}
    in_step = [joint for joint in next_to_hand if joint.name in coupled]
    driven = slides or motored or in_step or next_to_hand
    if not driven or not all(joint.name and joint.range[0] < joint.range[1] for joint in driven):
        raise UsageError(
            f"{path}: no joint with a name and a range moves the fingers; write the YAML by hand"
            " (docs/robots.md)"
        )
    return driven


def _ends(
    spec: mujoco.MjSpec, palm: Any, jaws: Sequence[Any], driven: Sequence[Any]
) -> dict[str, Any]:
    """Find each driven joint's closed and open positions, by the fingers' distance, and the
    bodies that touch.
    """
    names = {joint.name for joint in driven}
    moving = [
        jaw.name
        for jaw in jaws
        if not names.isdisjoint(joint.name for joint in jaw.find_all("joint"))
    ]
    bodies = moving if len(moving) > 1 else [palm.name, *moving]
    ranges = [joint_range(joint).tolist() for joint in driven]
    middle = [sum(ends) / 2 for ends in ranges]
    model = spec.compile()
    data, fingers = mujoco.MjData(model), finger_geoms(model, bodies)
    opposed = [[one, *(other for other in fingers if other is not one)] for one in fingers]
    q = [model.joint(joint.name).qposadr[0] for joint in driven]

    def gap(place: int, end: float) -> float:
        data.qpos[q] = [*middle[:place], end, *middle[place + 1 :]]
        mujoco.mj_kinematics(model, data)
        ends = np.array([nearest(model, data, groups)[1] for groups in opposed])
        centres = np.array([np.mean(data.geom_xpos[list(finger)], axis=0) for finger in fingers])
        apart = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean()
        return float(apart + np.linalg.norm(centres - centres.mean(axis=0), axis=1).sum())

    sides = [sorted(ends, key=partial(gap, place)) for place, ends in enumerate(ranges)]
    if len(moving) > 1:
        data.qpos[q] = [closed for closed, _ in sides]
        mujoco.mj_kinematics(model, data)
        bodies = [
            model.body(model.geom_bodyid[pad]).name for pad in nearest(model, data, fingers)[0]
        ]
    # no -0
    closed, opened = (
        [float(f"{end:.5g}") + 0.0 for end in ends] for ends in zip(*sides, strict=True)
    )
    return {
        "joints": [joint.name for joint in driven],
        "closed": closed,
        "open": opened,
        "fingers": bodies,
    }


def _workspace(model: mujoco.MjModel, hand: str) -> dict[str, Any]:
    """Propose a workspace, given the arm's length from its second joint to the hand and where
    its base is.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = model.body(hand).id
    places = [data.xpos[body]]
    while body:
        first = int(model.body_jntadr[body])
        places += list(data.xanchor[first : first + int(model.body_jntnum[body])])
        body = int(model.body_parentid[body])
    length = float(np.linalg.norm(np.diff(places[:-1], axis=0), axis=1).sum())
    x, y, _ = places[-1].tolist()
    return {
        "centre": [_to_centimetres(x + _REACHES * length), _to_centimetres(y)],
        "half_width": _to_centimetres(min(_MOST_WIDE, _HALF * length)),
        "height": _to_centimetres(min(_MOST_HIGH, 3 * _HALF * length)),
    }


def _to_centimetres(length: float) -> float:
    return round(length / 0.01) / 100


def yaml_of(found: Mapping[str, Any], model: str, gripper: str = "") -> str:
    """Return what `suggest` found as YAML text, with comments.

    Args:
        found: The result of `suggest`.
        model: Path of the robot's MJCF, as written to the YAML.
        gripper: Path of the gripper's MJCF, as written to the YAML; empty if it has none of its
            own.
    """
    values = {"model": model, "hand": found["hand"], **found["gripper"], **found["workspace"]}
    # JSON is YAML
    words = {key: json.dumps(value, ensure_ascii=False) for key, value in values.items()}
    return _YAML.format(own=f"\n  model: {json.dumps(gripper)}" if gripper else "", **words)
