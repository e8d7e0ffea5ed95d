"""Robot and task to one compiled scene: arm, table, cube, goal marker, cameras, light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.robot import Robot, get_robot
from manip_il.sim.task import Task, get_task
from manip_il.sim.world import CUBE_FRICTION, CUBE_HALF_SIZE, CUBE_MASS

DT_SIM = 0.002  # [s]
_TABLE_HALF = (0.45, 0.6, 0.02)  # [m]
_SHADOW_SIZE = 1024  # the shadow map is what costs on a software renderer
_OBJECT, _GOAL = "object", "goal"
STATE_KIND = int(mujoco.mjtState.mjSTATE_INTEGRATION)


@dataclass(frozen=True)
class Scene:
    """A compiled model and the addresses of what is named in it.

    `*_q`: indices into qpos; `*_ctrl`: into ctrl. `object_q` is the start of a free joint, or None.
    """

    robot: Robot
    task: Task
    model: mujoco.MjModel
    arm_q: NDArray[np.int64]
    finger_q: NDArray[np.int64]
    arm_v: NDArray[np.int64]
    arm_ctrl: NDArray[np.int64]
    finger_ctrl: NDArray[np.int64]
    object_q: int | None
    object_v: int | None
    ee_site: int
    goal_mocap: int
    arm_range: NDArray[np.float64]  # (arm, 2) [rad], infinite where a joint turns freely

    @property
    def qpos_slice(self) -> slice:
        """Where qpos stands in `State.physics`."""
        start = mujoco.mj_stateSize(self.model, int(mujoco.mjtState.mjSTATE_TIME))
        return slice(start, start + self.model.nq)

    @property
    def state_size(self) -> int:
        """Length of `State.physics`."""
        return mujoco.mj_stateSize(self.model, STATE_KIND)

    def model_bytes(self) -> bytes:
        """The compiled model, byte for byte: what a fingerprint hashes."""
        buffer = np.zeros(mujoco.mj_sizeModel(self.model), dtype=np.uint8)
        mujoco.mj_saveModel(self.model, None, buffer)
        return buffer.tobytes()


@cache
def build_scene(robot: str, task: str) -> Scene:
    """The scene of a robot and a task, compiled once a process. Raises `UnknownName`."""
    the_robot, the_task = get_robot(robot), get_task(task)
    spec = scene_spec(the_robot, the_task)
    return _index(the_robot, the_task, spec.compile())


def scene_spec(robot: Robot, task: Task) -> mujoco.MjSpec:
    """The uncompiled scene; world z = 0 is the table's top, x points away from the robot."""
    spec = robot.build()
    spec.option.timestep = DT_SIM
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10  # holds the cube: with the pyramidal default it creeps out of the hand
    for body in spec.bodies:
        body.gravcomp = 1.0
    for site in list(spec.sites):
        if site.name != "ee":
            spec.delete(site)
    _add_look(spec)
    _add_table(spec, robot)
    if task.has_object:
        _add_cube(spec)
    _add_goal(spec)
    _add_cameras(spec, robot)
    return spec


def arm_model(robot: Robot) -> mujoco.MjModel:
    """The arm alone, fingers fixed: what inverse kinematics works on."""
    spec = robot.build()
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for joint in robot.finger_joints:
        spec.delete(spec.joint(joint))
    for geom in list(spec.geoms):
        geom.contype = geom.conaffinity = 0
    return spec.compile()


def _index(robot: Robot, task: Task, model: mujoco.MjModel) -> Scene:
    def qpos(names: tuple[str, ...]) -> NDArray[np.int64]:
        return np.array([model.joint(name).qposadr[0] for name in names], dtype=np.int64)

    def ctrl(names: tuple[str, ...]) -> NDArray[np.int64]:
        return np.array([model.actuator(name).id for name in names], dtype=np.int64)

    limits = np.array([model.joint(name).range for name in robot.arm_joints])
    free = np.array([not model.joint(name).limited[0] for name in robot.arm_joints])
    limits[free] = [-np.inf, np.inf]
    return Scene(
        robot=robot,
        task=task,
        model=model,
        arm_q=qpos(robot.arm_joints),
        finger_q=qpos(robot.finger_joints),
        arm_v=np.array([model.joint(name).dofadr[0] for name in robot.arm_joints], dtype=np.int64),
        arm_ctrl=ctrl(robot.arm_joints),
        finger_ctrl=ctrl(robot.finger_joints),
        object_q=int(model.joint(_OBJECT).qposadr[0]) if task.has_object else None,
        object_v=int(model.joint(_OBJECT).dofadr[0]) if task.has_object else None,
        ee_site=model.site("ee").id,
        goal_mocap=int(model.body(_GOAL).mocapid[0]),
        arm_range=limits,
    )


def _add_look(spec: mujoco.MjSpec) -> None:
    spec.visual.headlight.ambient = [0.32, 0.32, 0.34]
    spec.visual.headlight.diffuse = [0.22, 0.22, 0.22]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.quality.shadowsize = _SHADOW_SIZE
    spec.visual.map.znear = 0.01
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    texture = mujoco.mjtTexture
    builtin = mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[0.84, 0.88, 0.92],
        rgb2=[0.55, 0.62, 0.70],
        width=256,
        height=256 * 6,
    )
    spec.add_material(name="floor", rgba=[0.80, 0.83, 0.86, 1], specular=0.0, emission=0.25)
    spec.add_material(name="table", rgba=[0.80, 0.70, 0.57, 1], specular=0.15, shininess=0.3)
    spec.add_material(name="cube", rgba=[0.86, 0.24, 0.16, 1], specular=0.3, shininess=0.5)
    spec.add_material(name="goal", rgba=[0.12, 0.72, 0.35, 0.55], specular=0.0, emission=0.4)
    spec.worldbody.add_light(
        pos=[0.9, -0.9, 1.8],
        dir=[-0.35, 0.75, -1.5],
        diffuse=[0.62, 0.60, 0.56],
        specular=[0.2, 0.2, 0.2],
        castshadow=True,
    )
    spec.worldbody.add_light(pos=[-0.5, 1.2, 1.5], dir=[0.6, -0.7, -1.0], diffuse=[0.2, 0.22, 0.26], castshadow=False)


def _add_table(spec: mujoco.MjSpec, robot: Robot) -> None:
    box, plane = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE
    x, y = robot.workspace
    half = np.array(_TABLE_HALF)
    spec.worldbody.add_geom(
        name="table", type=box, size=half, pos=[x + 0.08, y, -half[2]], material="table", friction=[1.0, 0.005, 0.0001]
    )
    for i, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        leg = [x + 0.08 + sx * (half[0] - 0.05), y + sy * (half[1] - 0.05), -0.22]
        spec.worldbody.add_geom(
            name=f"leg{i}", type=box, size=[0.025, 0.025, 0.18], pos=leg, rgba=[0.35, 0.36, 0.38, 1]
        )
    spec.worldbody.add_geom(name="floor", type=plane, size=[4, 4, 0.1], pos=[0, 0, -0.4], material="floor")
    if robot.name == "panda":  # a pedestal from the floor to the base
        spec.worldbody.add_geom(
            name="pedestal", type=box, size=[0.13, 0.13, 0.195], pos=[-0.04, 0, -0.205], rgba=[0.28, 0.29, 0.32, 1]
        )


def _add_cube(spec: mujoco.MjSpec) -> None:
    body = spec.worldbody.add_body(name=_OBJECT, pos=[0.5, 0, CUBE_HALF_SIZE])
    body.add_freejoint(name=_OBJECT)
    body.add_geom(
        name=_OBJECT,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[CUBE_HALF_SIZE] * 3,
        mass=CUBE_MASS,
        material="cube",
        condim=4,
        friction=[CUBE_FRICTION, 0.02, 0.0001],
        solimp=[0.95, 0.99, 0.001, 0.5, 2],
        solref=[0.01, 1],
    )


def _add_goal(spec: mujoco.MjSpec) -> None:
    """A marker without contacts; a mocap body, so that lockstep environments can share one model."""
    body = spec.worldbody.add_body(name=_GOAL, mocap=True, pos=[0.5, 0, 0.2])
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], material="goal", contype=0, conaffinity=0, mass=0
    )


def _add_cameras(spec: mujoco.MjSpec, robot: Robot) -> None:
    x, y = robot.workspace
    _look_at(spec, "front", eye=(x + 0.85, y - 0.72, 0.66), at=(x - 0.10, y, 0.20), fovy=45)
    hand = spec.site("ee").parent
    site = spec.site("ee")
    offset = np.array([0.10, 0.0, -0.08])  # in the ee frame: beside the hand, behind the fingertips [m]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(site.quat) / np.linalg.norm(site.quat))
    rotation = rotation.reshape(3, 3)
    # the camera looks along its -z; tilt it towards the fingertips
    tilt = 0.45
    back = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    axes = np.stack([np.array([0.0, 1.0, 0.0]), np.cross(back, [0.0, 1.0, 0.0]), back], axis=1)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, (rotation @ axes).flatten())
    hand.add_camera(name="wrist", pos=np.asarray(site.pos) + rotation @ offset, quat=quat, fovy=70)


def _look_at(spec: mujoco.MjSpec, name: str, eye: tuple[float, ...], at: tuple[float, ...], fovy: float) -> None:
    back = np.subtract(eye, at)
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).flatten())
    spec.worldbody.add_camera(name=name, pos=eye, quat=quat, fovy=fovy)
