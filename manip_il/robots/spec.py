"""A robot's model as an `MjSpec`: with position control and the site `ee`, without what belongs
to a scene.
"""

import fnmatch
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import F64
from manip_il.robots.robot import (
    GRIPPER,
    WRIST,
    CameraPose,
    GripperConfig,
    ModelFiles,
    Robot,
)

# defaults for what we add to a model, because its own defaults may set a material or a range
PLAIN = mujoco.MjSpec()
_KV_PER_KP = 1 / 20  # [s]: a time constant of one control step at 20 Hz
_DAMPING = 1.0  # damping of an arm joint [N m s/rad]
# of a sliding and of a turning finger: kp [N/m or N m/rad], kv, force [N or N m]; then armature
# [kg or kg m^2] and damping
_SLIDES = (800.0, 20.0, 40.0), 0.2, 10.0
_TURNS = (20.0, 0.5, 10.0), 0.005, 0.1
_LINK_ARMATURE, _LINK_DAMPING = 0.001, 0.02  # for a linkage's joint [kg m^2], [N m s/rad]
# added wrist camera: tilt towards the fingertips [rad], vertical field of view [deg]
_TILT, _FOVY = 0.45, 70.0
# compiler options
_OF_A_SCENE = ("fusestatic", "discardvisual", "settotalmass", "alignfree", "saveinertial")
_SCALAR = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


def load(files: ModelFiles, robot: str) -> mujoco.MjSpec:
    """Read a model, without compiler options that would affect the whole scene.

    Args:
        files: The model's files.
        robot: The robot's name, for messages.

    Raises:
        UsageError: If MuJoCo cannot read the model.
    """
    spec = files.load(robot)
    _turn_inertias(spec)
    for name in _OF_A_SCENE:
        setattr(spec.compiler, name, getattr(PLAIN.compiler, name))
    return spec


def joint_range(joint: Any) -> F64:
    """Return a joint's range (2,) [rad or m], whatever the unit of the file that it comes from."""
    in_degrees = joint.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
    return np.radians(joint.range) if in_degrees else np.array(joint.range)


def _turn_inertias(spec: mujoco.MjSpec) -> None:
    """Replace inertia tensors of a URDF by principal moments, as MuJoCo does but without their
    origin's rotation.

    Its reader gives `iquat`, the axes with that rotation, which its compiler replaces by the
    tensor's own axes.
    """
    for body in spec.bodies:
        tensor = np.array(body.fullinertia)  # xx, yy, zz, xy, xz, yz
        # no tensor, or one of an MJCF
        if np.isnan(tensor).any() or tuple(body.iquat) == (1, 0, 0, 0):
            continue
        moments = np.zeros(3)
        mujoco.mju_eig3(moments, np.zeros(9), np.zeros(4), tensor[[0, 3, 4, 3, 1, 5, 4, 5, 2]])
        body.inertia, body.fullinertia = moments, np.full(6, np.nan)


def bare_spec(
    robot: str, files: ModelFiles, hand: str, gripper: GripperConfig, camera: str = ""
) -> mujoco.MjSpec:
    """Return a robot's model without what belongs to a scene.

    A gripper with its own model is attached to the hand.

    Args:
        robot: The robot's name, for messages.
        files: The arm's model.
        hand: Name of the body that carries the gripper.
        gripper: The gripper, of which only its own model and its pose in the hand's body are used.
        camera: Name of the model's camera on the hand, kept as `wrist`; empty if there is none.

    Raises:
        UsageError: If MuJoCo cannot read a file.
        UnknownName: If the model does not have the hand's body or the camera.
    """
    spec = load(files, robot)
    require(robot, "body", (hand,), spec.bodies)
    if camera:
        require(robot, "camera", (camera,), spec.cameras)
        spec.camera(camera).name = WRIST
    _remove_scene_elements(spec, hand, WRIST if camera else "")
    if gripper.files is None:
        return spec
    hand_spec = load(gripper.files, robot)
    _remove_scene_elements(hand_spec)
    copy_options(spec, hand_spec)
    mount = spec.body(hand).add_frame(pos=gripper.position, quat=gripper.quaternion)
    spec.attach(hand_spec, prefix=GRIPPER, frame=mount)
    return spec


def arm_joints(robot: str, files: ModelFiles, hand: str, gripper: GripperConfig) -> tuple[str, ...]:
    """Return the names of the hinges between the base and the hand, except the gripper's.

    Args:
        robot: The robot's name, for messages.
        files: The arm's model.
        hand: Name of the body that carries the gripper.
        gripper: The gripper, whose joints are left out.

    Returns:
        The names, from base to hand.

    Raises:
        UsageError: If there is no such hinge, or MuJoCo cannot read a file.
        UnknownName: If the model does not have the hand's body.
    """
    spec = bare_spec(robot, files, hand, gripper)
    above = _joints_above(spec.body(hand))
    hinges = [joint.name for joint in above if joint.type == mujoco.mjtJoint.mjJNT_HINGE]
    joints = tuple(name for name in hinges if name not in gripper.joints)
    if not joints:
        raise UsageError(
            f"robot {robot}: there is no hinge between the base and hand {hand!r}; check hand"
        )
    return joints


def arm_spec(robot: Robot) -> mujoco.MjSpec:
    """Return the arm and gripper as a spec.

    It is position-controlled, with the site `ee`, and has nothing else.

    Raises:
        UsageError: If a joint, body or file is missing; the message names it, and those that exist.
    """
    place = robot.wrist_place
    camera = place if isinstance(place, str) else ""
    spec = bare_spec(robot.name, robot.files, robot.hand, robot.gripper, camera)
    require(robot.name, "joint", (*robot.joints, *robot.gripper.joints), spec.joints)
    require(robot.name, "body", (robot.hand, robot.ee.body, *robot.gripper.fingers), spec.bodies)
    linked = linkage(spec, robot)
    _fix_joints(robot, spec, linked)
    if linked:
        _keep_links_apart(spec, robot.hand)
    for name in linked:  # a little inertia and damping keep undriven joints from ringing
        joint = spec.joint(name)
        joint.armature = max(joint.armature, _LINK_ARMATURE)
        joint.damping = np.maximum(joint.damping, [_LINK_DAMPING, 0, 0])
    _motorise(robot, spec)
    ee = robot.ee
    spec.body(ee.body).add_site(
        PLAIN.default, name="ee", size=[0.004] * 3, group=4, pos=ee.position, quat=ee.quaternion
    )
    for body in spec.bodies:
        body.gravcomp = 1.0
        if robot.gripper.finger_mass and body.name in robot.gripper.fingers:
            body.mass, body.inertia = robot.gripper.finger_mass, np.full(3, 1e-4)
    _paint(robot, spec)
    return spec


def add_wrist_camera(
    spec: mujoco.MjSpec, model: mujoco.MjModel, place: CameraPose | Sequence[float]
) -> None:
    """Add the camera `wrist` to an arm.

    Args:
        spec: The arm, with the site `ee`; the camera is added to the body of this site.
        model: The same arm, compiled.
        place: Pose of the camera in the frame `ee`; or its position, (3,) [m], if it is tilted
            towards the fingertips: it then looks along its -z, and its x is parallel to the hand's
            y.
    """
    rotation, quat = np.zeros((3, 3)), np.zeros(4)
    site = model.site("ee")
    mujoco.mju_quat2Mat(rotation.ravel(), site.quat)
    if isinstance(place, CameraPose):
        fovy, position = place.fovy, place.position
        mujoco.mju_mulQuat(quat, site.quat, place.quaternion)
    else:
        fovy, position = _FOVY, place
        side = np.sign(place[0]) or 1.0
        back = np.array([side * np.sin(_TILT), 0, -np.cos(_TILT)])
        right = np.array([0.0, side, 0.0])
        axes = np.stack([right, np.cross(back, right), back], axis=1)
        mujoco.mju_mat2Quat(quat, (rotation @ axes).ravel())
    hand: Any = spec.site("ee")
    at = site.pos + rotation @ np.array(position)
    hand.parent.add_camera(PLAIN.default, name=WRIST, pos=at, quat=quat, fovy=fovy)


def arm_model(robot: Robot) -> mujoco.MjModel:
    """Compile the arm alone, with fixed fingers, for inverse kinematics."""
    spec = arm_spec(robot)
    for element in [*spec.actuators, *spec.tendons, *spec.equalities]:
        spec.delete(element)
    for name in (*robot.gripper.joints, *linkage(spec, robot)):
        spec.delete(spec.joint(name))
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    spec.compiler.discardvisual = True  # meshes take up to 64 MB
    return spec.compile()


def model_bytes(model: mujoco.MjModel) -> bytes:
    """Return the bytes of a compiled model, for fingerprints."""
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def require(robot: str, kind: str, names: Sequence[str], there: Sequence[Any]) -> None:
    """Check that a robot's model has all elements that its YAML names.

    Args:
        robot: The robot's name, for messages.
        kind: What the elements are, such as joint.
        names: Names in the YAML.
        there: Elements of the model.

    Raises:
        UnknownName: If no element has one of the names.
    """
    known = [one.name for one in there if one.name and one.name != "world"]
    for name in names:
        if name not in known:
            raise UnknownName(f"{kind} in the YAML of robot {robot}:", name, known)


def linkage(spec: mujoco.MjSpec, robot: Robot) -> list[str]:
    """Return the names of the joints of the gripper's linkage.

    These are the joints beyond the hand that nothing drives or fixes.

    Args:
        spec: The robot's model.
        robot: The robot.
    """
    apart = {*robot.joints, *robot.gripper.joints, *robot.fixed}
    below = spec.body(robot.hand).find_all("joint")
    return [
        joint.name for joint in below if joint.parent.name != robot.hand and joint.name not in apart
    ]


def _keep_links_apart(spec: mujoco.MjSpec, hand: str) -> None:
    """Exclude contacts between parts of a linkage, which overlap in most models and would jam."""
    below = spec.body(hand).find_all("body")
    for number, body in enumerate(below):
        body.name = body.name or f"{hand} part {number}"
    bodies = [hand, *(body.name for body in below)]
    there = {frozenset((one.bodyname1, one.bodyname2)) for one in spec.excludes}
    for one, other in itertools.combinations(bodies, 2):
        if frozenset((one, other)) not in there:
            spec.add_exclude(bodyname1=one, bodyname2=other)


def _fix_joints(robot: Robot, spec: mujoco.MjSpec, linked: Sequence[str]) -> None:
    """Delete joints that are neither the arm's nor the gripper's, leaving their bodies where the
    YAML says.
    """
    kept = {*robot.joints, *robot.gripper.joints, *linked}
    loose = [joint for joint in spec.joints if joint.name not in kept]
    if robot.fixed:
        scalar = [joint for joint in loose if joint.type in _SCALAR]
        require(robot.name, "joint", tuple(robot.fixed), scalar)
        _place_bodies(spec, robot.fixed)
    for equality in list(spec.equalities):
        coupled = _coupled(spec, equality)
        if equality.active and not coupled.isdisjoint(robot.joints):
            raise UsageError(
                f"robot {robot.name}: equality {equality.name or '(unnamed)'} couples"
                f" {', '.join(sorted(coupled))}; expected arm joints that move independently (those"
                " left out of joints are fixed)"
            )
        if equality.type == mujoco.mjtEq.mjEQ_JOINT and not coupled <= kept:
            spec.delete(equality)
    for joint in loose:
        spec.delete(joint)
    if robot.base is not None:
        root = spec.body(robot.hand)
        while root.parent.name != "world":
            root = root.parent
        root.pos = np.array(robot.base)


def _coupled(spec: mujoco.MjSpec, equality: mujoco._specs.MjsEquality) -> set[str]:
    """The names of the joints that an equality of joints names, or that move one of its bodies
    against the other.
    """
    ends = equality.name1, equality.name2
    if equality.type == mujoco.mjtEq.mjEQ_JOINT:
        return set(filter(None, ends))
    one, other = ({joint.name for joint in _joints_above(spec.body(name))} for name in ends)
    return one ^ other


def _joints_above(body: Any) -> list[Any]:
    """The joints between the world and a body, from the world outwards."""
    if body is None or body.name == "world":
        return []
    return [*_joints_above(body.parent), *body.joints]


def _place_bodies(spec: mujoco.MjSpec, fixed: Mapping[str, float]) -> None:
    """Move bodies to where they are when their joints stand at `fixed` [rad or m]."""
    twin = spec.copy()
    model = twin.compile()
    data = mujoco.MjData(model)
    for name, value in fixed.items():
        data.joint(name).qpos[0] = value
    model.body_parentid[:] = 0  # so that kinematics gives poses in the parent's frame
    mujoco.mj_kinematics(model, data)
    for body, there in zip(spec.bodies, twin.bodies, strict=True):
        if not fixed.keys() & {joint.name for joint in body.joints}:
            continue
        place, turn = data.xpos[there.id], data.xmat[there.id].reshape(3, 3)
        # kept joints keep axis and anchor
        for joint, own in zip(body.joints, there.joints, strict=True):
            joint.axis, joint.pos = data.xaxis[own.id] @ turn, (data.xanchor[own.id] - place) @ turn
        body.set_frame(body.parent.add_frame())
        body.pos, body.quat = place, data.xquat[there.id]
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _remove_scene_elements(spec: mujoco.MjSpec, hand: str = "", kept: str = "") -> None:
    """Delete what belongs to a scene: motors, mocap bodies, sky, cameras, gravity and time step.

    hand: if given, all that is not in this body's tree also belongs to the scene: a floor, a table,
    what lies on it.
    """
    for element in _scene_elements(spec, hand, kept):
        spec.delete(element)
    copy_options(PLAIN, spec)
    for name in dir(spec):
        if name.startswith("nuser_"):
            setattr(spec, name, -1)


def copy_options(origin: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    """Copy physics options from one spec to another.

    MuJoCo warns if two specs that it joins have different ones.

    Args:
        origin: The spec to copy from.
        spec: The spec to change.
    """
    for name in dir(origin.option):
        if not name.startswith("_"):
            setattr(spec.option, name, getattr(origin.option, name))


def _scene_elements(spec: mujoco.MjSpec, hand: str, kept: str) -> Iterator[Any]:
    """Yield what to delete.

    Each kind is looked up at its turn, as MuJoCo deletes what depends on a body, too.
    """
    yield from list(spec.keys)
    yield from [body for body in spec.bodies if body.mocap]
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    yield from [
        geom for geom in spec.geoms if geom.type == plane or (hand and geom.parent.name == "world")
    ]
    geoms, site = {geom.name for geom in spec.geoms}, mujoco.mjtObj.mjOBJ_SITE
    yield from [pair for pair in spec.pairs if not {pair.geomname1, pair.geomname2} <= geoms]
    yield from [equality for equality in spec.equalities if equality.objtype == site]
    trees = [
        (body, {one.name for one in (body, *body.find_all("body"))})
        for body in spec.worldbody.bodies
    ]
    yield from [body for body, names in trees if hand and hand not in names]
    used = {name for material in spec.materials for name in material.textures}
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    yield from [one for one in spec.textures if one.type == sky or one.name not in used]
    yield from [camera for camera in spec.cameras if not kept or camera.name != kept]
    for kind in ("actuators", "sensors", "lights", "sites", "tuples"):
        yield from list(getattr(spec, kind))


def _paint(robot: Robot, spec: mujoco.MjSpec) -> None:
    for geom in spec.geoms:
        for pattern, colour in robot.colours.items():
            if (
                geom.meshname
                and fnmatch.fnmatch(geom.meshname, pattern)
                and not (geom.contype or geom.conaffinity)
            ):
                geom.rgba = np.array([*colour, 1.0])


def _motorise(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Give the joints of arm and gripper position control in place of the model's motors."""
    for name, kp, force, armature in zip(
        robot.joints, robot.gains, robot.forces, robot.armature, strict=True
    ):
        joint = spec.joint(name)
        joint.damping = np.array([_DAMPING, 0, 0])
        joint.stiffness = np.zeros(3)
        joint.armature = armature
        joint.frictionloss = 0.0  # a servo's own controller overcomes friction
        _position_actuator(spec, joint, (kp, kp * _KV_PER_KP, force))
    gripper = robot.gripper
    for name, *ends in zip(gripper.joints, gripper.closed, gripper.open, strict=True):
        joint = spec.joint(name)
        slides = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
        (kp, kv, force), joint.armature, damping = _SLIDES if slides else _TURNS
        joint.damping = np.array([damping, 0, 0])
        joint.frictionloss = 0.0
        if joint.range[0] >= joint.range[1]:  # a linkage that runs past its end folds over
            in_degrees = joint.compiler.degree and not slides
            joint.range = np.degrees(sorted(ends)) if in_degrees else sorted(ends)
        _position_actuator(spec, joint, (kp, kv, gripper.force or force))


def _position_actuator(spec: mujoco.MjSpec, joint: Any, gains: tuple[float, float, float]) -> None:
    """Add PD position control of one joint: force = kp (ctrl - q) - kv v, within +-force [N or N
    m].
    """
    kp, kv, force = gains
    actuator = spec.add_actuator(
        PLAIN.default, name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
    )
    actuator.set_to_position(kp=kp, kv=kv)
    actuator.forcelimited, actuator.forcerange = True, [-force, force]
    if joint.range[0] < joint.range[1]:
        actuator.ctrllimited, actuator.ctrlrange = True, joint_range(joint)
