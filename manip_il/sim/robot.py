"""The robots: one table entry each, and the function that builds its arm as an `MjSpec`."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from manip_il.errors import ManipError, UnknownName


@dataclass(frozen=True)
class Robot:
    """A joint-position-controlled arm with a parallel gripper, as the rest of the program needs it.

    The site `ee` sits between the fingertips, z out of the hand, y along the fingers' motion. With the
    hand pointing straight down at zero yaw its axes are world x, -y, -z.
    """

    name: str
    arm_joints: tuple[str, ...]
    finger_joints: tuple[str, str]
    home: tuple[float, ...]  # arm posture over the workspace, hand down [rad]
    max_opening: float  # both fingers together [m]
    pad_gap: float  # gap between the pads when the opening reads 0 [m]
    max_joint_step: float  # the longest step of a joint target from the measured joint [rad]
    workspace: tuple[float, float]  # centre of the task area on the table, x and y [m]
    shoulder: tuple[float, float, float]  # where reach is measured from [m]
    wrist_above_ee: float  # height of the wrist over the ee when the hand points down [m]
    reach: float  # shoulder to wrist, hand down, at which the IK still has room [m]
    head: tuple[float, float, float] | None  # what the upper arm must not be folded against [m]
    head_clearance: float  # of the wrist from it, hand down [m]
    build: Callable[[], mujoco.MjSpec]

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of `observation.state` and `action`: arm joints, then the gripper."""
        return (*self.arm_joints, "gripper")


def get_robot(name: str) -> Robot:
    """The table's entry; raises `UnknownName`."""
    if name not in ROBOTS:
        raise UnknownName("robot", name, ROBOTS)
    return ROBOTS[name]


def assets_folder() -> Path:
    """Where gymnasium-robotics keeps its models (found without importing it)."""
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None or found.origin is None:
        raise ManipError("gymnasium-robotics is not installed; run: make setup")
    return Path(found.origin).parent / "envs" / "assets"


def _load(xml: str, folder: Path, files: tuple[str, ...], mesh_folder: Path) -> mujoco.MjSpec:
    """An `MjSpec` from a wrapper XML, its included files and one folder of meshes."""
    include = {name: (folder / name).read_bytes() for name in files}
    assets = {str(path.relative_to(mesh_folder)): path.read_bytes() for path in mesh_folder.rglob("*.stl")}
    return mujoco.MjSpec.from_string(xml, include=include, assets=assets)


def _motorise(spec: mujoco.MjSpec, arm: tuple[str, ...], fingers: tuple[str, str], gains: tuple[float, ...]) -> None:
    """Position control of every joint, kp [N m/rad] each in `gains`; kv = kp / 20 gives a time constant of one step."""
    for joint, kp in zip(arm, gains, strict=True):
        element = spec.joint(joint)
        element.damping, element.stiffness = np.array([1.0, 0.0, 0.0]), np.zeros(3)
        element.armature = 0.1
        _position_actuator(spec, joint, kp=kp, kv=kp / 20, force=200.0)
    for joint in fingers:
        element = spec.joint(joint)
        element.damping = np.array([10.0, 0.0, 0.0])
        element.armature = 0.2
        _position_actuator(spec, joint, kp=800, kv=20, force=40.0)


def _position_actuator(spec: mujoco.MjSpec, joint: str, kp: float, kv: float, force: float) -> None:
    """PD position control of one joint: force = kp (ctrl - q) - kv v, within +-force [N or N m]."""
    limits = spec.joint(joint)
    actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=kp, kv=kv)
    actuator.forcelimited, actuator.forcerange = True, [-force, force]
    if limits.range[0] < limits.range[1]:
        actuator.ctrllimited, actuator.ctrlrange = True, limits.range


def _build_panda() -> mujoco.MjSpec:
    """Franka Emika Panda from gymnasium-robotics' kitchen assets (Apache-2.0)."""
    folder = assets_folder() / "kitchen_franka" / "franka_assets"
    xml = """<mujoco model="panda"><include file="assets.xml"/>
      <worldbody><include file="chain.xml"/></worldbody></mujoco>"""
    spec = _load(xml, folder, ("assets.xml", "chain.xml"), folder / "meshes")
    spec.meshdir = ""
    _motorise(spec, _PANDA_ARM, _PANDA_FINGERS, gains=(4500, 4500, 3500, 3500, 2000, 2000, 2000))
    # The shipped `end_effector` site is 5 cm above the fingertips: too high to hold anything.
    link7 = spec.body("panda0_link7")
    link7.add_site(name="ee", pos=[0, 0, 0.243], quat=_about_z(-np.pi / 4), size=[0.004] * 3, group=4)
    _paint_panda(spec)
    return spec


def _paint_panda(spec: mujoco.MjSpec) -> None:
    for geom in spec.geoms:
        if geom.classname.name in ("panda_viz",):
            dark = geom.meshname in ("hand_viz", "finger_viz", "link7_viz")
            geom.rgba = np.array([0.22, 0.23, 0.26, 1] if dark else [0.93, 0.94, 0.95, 1])


def _build_fetch() -> mujoco.MjSpec:
    """Fetch's arm on its fixed base, from gymnasium-robotics' assets; the mocap weld is left out."""
    folder = assets_folder() / "fetch"
    xml = """<mujoco model="fetch"><compiler angle="radian"/><include file="shared.xml"/>
      <worldbody><include file="robot.xml"/></worldbody></mujoco>"""
    spec = _load(xml, folder, ("shared.xml", "robot.xml"), folder.parent / "stls" / "fetch")
    for equality in list(spec.equalities):
        spec.delete(equality)
    spec.delete(spec.body("robot0:mocap"))
    for texture in list(spec.textures):
        spec.delete(texture)
    for joint in list(spec.joints):
        if joint.name not in (*_FETCH_ARM, *_FETCH_FINGERS):
            spec.delete(joint)
    spec.body("robot0:base_link").pos = [0, 0, -_FETCH_TABLE_HEIGHT]
    spec.body("robot0:torso_lift_link").pos = [-0.0869, 0, 0.3774 + _FETCH_TORSO_LIFT]
    for camera in list(spec.cameras):
        spec.delete(camera)
    _motorise(spec, _FETCH_ARM, _FETCH_FINGERS, gains=(3000, 3000, 2000, 2000, 1000, 1000, 500))
    for joint in _FETCH_FINGERS:  # the stock 4 kg a finger are there for the mocap weld
        spec.joint(joint).parent.mass = 0.1
        spec.joint(joint).parent.inertia = np.full(3, 1e-4)
    hand = spec.body("robot0:gripper_link")
    # ee axes in the link: x = link z, y = -link y (the fingers' motion), z = link x (out of the hand)
    hand.add_site(name="ee", pos=[0.02, 0, 0], quat=[0, np.sqrt(0.5), 0, np.sqrt(0.5)], size=[0.004] * 3, group=4)
    return spec


def _about_z(angle: float) -> list[float]:
    return [float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2))]


_PANDA_ARM = tuple(f"robot:panda0_joint{i}" for i in range(1, 8))
_PANDA_FINGERS = ("robot:panda0_finger_joint1", "robot:panda0_finger_joint2")
_FETCH_ARM = tuple(
    f"robot0:{name}_joint"
    for name in (
        "shoulder_pan",
        "shoulder_lift",
        "upperarm_roll",
        "elbow_flex",
        "forearm_roll",
        "wrist_flex",
        "wrist_roll",
    )
)
_FETCH_FINGERS = ("robot0:r_gripper_finger_joint", "robot0:l_gripper_finger_joint")
_FETCH_TABLE_HEIGHT = 0.4  # of the table top over the floor, as in the stock task [m]
_FETCH_TORSO_LIFT = 0.2  # within the joint's range of 0.0386 to 0.3861 [m]

ROBOTS = {
    "panda": Robot(
        name="panda",
        arm_joints=_PANDA_ARM,
        finger_joints=_PANDA_FINGERS,
        home=(0.0, -0.188, 0.0, -2.492, 0.0, 0.733, 0.0),
        max_opening=0.08,
        pad_gap=-0.002,
        max_joint_step=0.1,
        workspace=(0.45, 0.0),
        shoulder=(0.0, 0.0, 0.333),
        wrist_above_ee=0.243,
        reach=0.7,
        head=None,
        head_clearance=0.0,
        build=_build_panda,
    ),
    "fetch": Robot(
        name="fetch",
        arm_joints=_FETCH_ARM,
        finger_joints=_FETCH_FINGERS,
        home=(0.0, -0.63, 0.0, 1.51, 0.0, 0.69, 0.0),
        max_opening=0.1,
        pad_gap=0.0,
        max_joint_step=0.1,
        workspace=(0.64, 0.0),
        shoulder=(0.15, 0.0, 0.586),
        wrist_above_ee=0.305,
        reach=0.675,
        head=(-0.034, 0.0, 0.78),
        head_clearance=0.6,
        build=_build_fetch,
    ),
}
