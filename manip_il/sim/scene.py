"""Build one compiled scene of robot and task: the robot is attached to the world's spec."""

import math
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from manip_il.checks import one_line
from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import I64
from manip_il.robots.action_space import ActionSpace
from manip_il.robots.geometry import angle_across, outline, yaw_ahead
from manip_il.robots.gripper import Gripper
from manip_il.robots.robot import TABLE_BEYOND, CameraPose, Robot
from manip_il.robots.spec import add_wrist_camera, arm_spec, copy_options
from manip_il.sim import variation
from manip_il.sim.config import DT_SIM
from manip_il.sim.rests import LEAST_HEIGHT, LEAST_ROOM, Hull
from manip_il.sim.servo import ArmServos, memory_size
from manip_il.sim.shape import ANY
from manip_il.sim.variation import Object

_EMPTY = Path(__file__).with_name("empty.xml")
STATE_KIND = int(mujoco.mjtState.mjSTATE_INTEGRATION)
# scenes cached per process, and what is computed from one: the finest meshes take 64 MB
SCENES_KEPT = 4
USUAL = 0.15  # half width of Panda's workspace [m]
PREFIX = "robot/"  # prefix of the robot's names in a scene
TABLE = "table"  # name of the table's geom
_THICK = 0.04  # thickness of the table's top [m]
_SPARE_TURN = 0.1  # margin to the limits of the last joint [rad]
# height of the workspace for which `_CAMERAS` are placed; its half width is `USUAL` [m]
_SEEN_HEIGHT = 0.45
# Camera positions, from the workspace's middle on the table; height above it of the point that they
# look at; vertical field of view.
_CAMERAS = {"front": (0.80, -0.15, 0.55), "side": (-0.05, -0.80, 0.50)}  # [m]
_LOOK_AT, _FIELD = 0.17, 42.0  # [m], [deg]
# a robot stands on the table only if its lowest point is this near to the table's top [m]
_ON_TABLE = 0.02
_PEDESTAL = 0.13  # half the pedestal's width [m]


class Scene:
    """A robot and a task's objects as one compiled model, and the addresses of its named parts.

    Attributes:
        robot: The robot.
        task: The `Task`.
        name: Robot and task, for messages.
        model: The compiled model.
        state_size: Length of `State.physics`.
        gripper: The robot's gripper in the model.
        actions: Names and bounds of actions.
        objects: Free bodies, by name.
        hulls: Convex hulls, by name, of the objects that are meshes.
        furniture: Ids of the geoms of mocap bodies, (g,): goal markers and the fixed parts of the
            task.
        arm_q: Indices of the arm's joints into `qpos`, (arm,).
        arm_ctrl: Indices of the arm's actuators into `ctrl`, (arm,).
        servos: The robot's servos; None if they are ideal.
        ee_site: Id of the site `ee`.
        shoulder: Id of the arm's first joint.
        yaws: Least and greatest yaw of the hand, relative to `World.ahead` [rad].
        nominal: The variation of the model as compiled, (v,).
        draws_shape: Whether each episode draws the shape of the object; the model as compiled has a
            cube.
        scale: Width of the workspace as a share of Panda's, at most 1.
    """

    def __init__(self, robot: Robot, task: Any, model: mujoco.MjModel):
        """Find the parts of a scene.

        Args:
            robot: The robot.
            task: The `Task`, fitted to the robot.
            model: The compiled model.
        """
        self.robot = robot
        self.task = task
        self.name = f"{robot.name} {task.name}"
        self.model = model
        self.state_size = mujoco.mj_stateSize(model, STATE_KIND)
        joints = [model.joint(PREFIX + name) for name in robot.joints]
        motors = [model.actuator(PREFIX + name) for name in robot.joints]
        self.gripper = Gripper(robot, model, PREFIX)
        self.actions = _action_space(robot, joints, self.gripper)
        self.objects = _objects(model)
        self.hulls = {
            name: Hull(model, one.body, one.geom, robot.ee.lowest, self.gripper.most)
            for name, one in self.objects.items()
            if model.geom_type[one.geom] == variation.MESH
        }
        roots = model.body_rootid[model.geom_bodyid]
        self.furniture: I64 = np.flatnonzero(model.body_mocapid[roots] >= 0)
        self.arm_q = np.array([joint.qposadr[0] for joint in joints], np.int64)
        self.arm_ctrl = np.array([motor.id for motor in motors], np.int64)
        driven = [
            np.append(self.arm_q, self.gripper.q),
            np.append(self.arm_ctrl, self.gripper.ctrl),
        ]
        self.servos = ArmServos(robot, model, *driven) if robot.servos else None
        self.ee_site: int = model.site(PREFIX + "ee").id
        self.shoulder: int = joints[0].id
        self.yaws = _yaws(robot, model, joints, self.arm_q)
        self.nominal = variation.nominal(model, self.objects)
        self.draws_shape: bool = task.shape.kind == ANY
        self.scale = min(1.0, robot.workspace.half_width / USUAL)


@lru_cache(SCENES_KEPT)
def build_scene(robot: Robot, task: Any, step: float = DT_SIM) -> Scene:
    """Return the scene of a robot and a task, compiled once and cached.

    Args:
        robot: The robot.
        task: The task, whose fixed parts are scaled to the robot.
        step: Physics time step [s].

    Raises:
        UsageError: If the scene does not compile, lacks an object of the task, or has one to grasp
            that does not fit the gripper.
    """
    task = task.fitted(robot)
    try:
        spec = scene_spec(robot, task)
        spec.option.timestep = step
        spec.nuserdata = memory_size(robot, step)
        model = spec.compile()
    except ValueError as error:
        raise UsageError(
            f"the scene of robot {robot.name} ({robot.files.model}) and task {task.name} does not"
            f" compile: {one_line(error)}"
        ) from None
    scene = Scene(robot, task, model)
    _check_objects(scene)
    return scene


def scene_spec(robot: Robot, task: Any) -> mujoco.MjSpec:
    """Return the uncompiled scene; world z = 0 is the table's top, x points away from the robot."""
    spec = mujoco.MjSpec.from_file(str(_EMPTY))
    spec.modelname = f"{robot.name}_{task.name}"
    _fit_table(spec, robot)
    arm = arm_spec(robot)
    arm_alone = arm.copy().compile()
    _add_pedestal(spec, arm_alone, robot)
    if not isinstance(place := robot.wrist_place, str):
        add_wrist_camera(arm, arm_alone, place)
    copy_options(spec, arm)
    spec.attach(arm, prefix=PREFIX, frame=spec.worldbody.add_frame())
    _add_cameras(spec, robot)
    task.build(spec)
    return spec


def camera_id(model: mujoco.MjModel, name: str) -> int:
    """Return the id of a camera of the world or on the robot.

    Args:
        model: The compiled scene.
        name: Name of the camera, without the robot's prefix.

    Raises:
        UnknownName: If there is no such camera.
    """
    known = [model.camera(i).name.removeprefix(PREFIX) for i in range(model.ncam)]
    if name not in known:
        raise UnknownName("camera", name, known)
    return known.index(name)


def _yaws(
    robot: Robot, model: mujoco.MjModel, joints: list[Any], arm_q: Any
) -> tuple[float, float]:
    """Least and greatest yaw to which a robot's last joint turns the hand, relative to
    `yaw_ahead` [rad].
    """
    if not robot.leans or not joints[-1].limited[0]:
        return -np.inf, np.inf
    data, last = mujoco.MjData(model), joints[-1]
    data.qpos[arm_q] = robot.home
    mujoco.mj_kinematics(model, data)
    ee = data.site(PREFIX + "ee")
    ahead = yaw_ahead(robot, data.xanchor[joints[0].id], ee.xpos)
    yaw = math.remainder(angle_across(ee.xmat.reshape(3, 3)) - ahead, 2 * np.pi)
    sign = np.sign(data.xaxis[last.id, 2])  # whether the joint turns the hand as a yaw does
    ends = [yaw + sign * (end - robot.home[-1]) for end in last.range]
    return min(ends) + _SPARE_TURN, max(ends) - _SPARE_TURN


def _objects(model: mujoco.MjModel) -> dict[str, Object]:
    """The free bodies, by name, in the model's order."""
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    bodies = [model.body(model.jnt_bodyid[joint]) for joint in free]
    return {
        body.name: Object(body.name, body.id, *map(int, (*body.geomadr, *place)))
        for body, *place in zip(
            bodies, model.jnt_qposadr[free], model.jnt_dofadr[free], strict=True
        )
    }


def _check_objects(scene: Scene) -> None:
    """Raise `UsageError` for an object that the scene does not have, or that is too wide or too
    low to grip.
    """
    task, model = scene.task, scene.model
    most = scene.gripper.most
    for name in (*task.objects, *task.grasped):
        if name not in scene.objects:
            raise UnknownName(f"object of task {task.name}", name, scene.objects)
    for name in task.grasped:
        geom, high = scene.objects[name].geom, ""
        kind, lengths = int(model.geom_type[geom]), 2 * model.geom_aabb[geom, 3:]
        if name in scene.hulls:
            rest = scene.hulls[name].rest(0)
            width, fits = min(width for width, _ in rest.sizes), rest.fits
            high = (
                f"rests {rest.tall:.3f} m high ({LEAST_HEIGHT} m is the least; {LEAST_ROOM} m"
                " beside it must be free), "
            )
        # width between the fingers if the object lies on its worst side
        elif kind in variation.KINDS:
            width = float(np.sort(lengths)[1])
            fits = width < most
        else:
            raise UsageError(
                f"task {task.name}: the first geom of {name!r} is of MuJoCo's type {kind}; expected"
                f" {', '.join(variation.GEOMS)} or mesh"
            )
        if not fits:
            raise UsageError(
                f"task {task.name}: {name!r} {high}is {width:.3f} m wide, and the gripper of"
                f" {scene.robot.name} opens to {most:.3f} m; choose another object, task or robot"
            )


def _action_space(robot: Robot, joints: list[Any], gripper: Gripper) -> ActionSpace:
    limits = [joint.range if joint.limited[0] else [-np.inf, np.inf] for joint in joints]
    low, high = np.vstack([*limits, [gripper.least, gripper.most]]).T
    scale = np.append(np.full(len(joints), robot.max_joint_step), gripper.most - gripper.least)
    relative, units = np.arange(len(scale)) < len(joints), None
    if robot.lerobot is not None:
        openings, driven = gripper.driven
        units = openings, robot.lerobot.percent(driven)
        low, high, scale = np.degrees([low, high, scale])
        low[-1], high[-1] = np.sort(units[1][[0, -1]])
        scale[-1] = high[-1] - low[-1]
    return ActionSpace(robot.joint_names, low, high, scale, relative, units)


def _fit_table(spec: mujoco.MjSpec, robot: Robot) -> None:
    table, y = robot.table, robot.workspace.centre[1]
    half = np.array([*table.size, _THICK]) / 2
    middle = [_table_x(robot), y, -half[2]]
    top = spec.geom(TABLE)
    top.size, top.pos = half, middle
    for i, (sx, sy) in enumerate(product((1, -1), repeat=2)):
        leg = spec.geom(f"leg{i}")
        leg.size = [0.025, 0.025, round((table.height - _THICK) / 2, 9)]
        leg.pos = [
            middle[0] + sx * (half[0] - 0.05),
            y + sy * (half[1] - 0.05),
            -(table.height + _THICK) / 2,
        ]
    spec.geom("floor").pos = [0, 0, -table.height]


def _table_x(robot: Robot) -> float:
    return robot.workspace.centre[0] + TABLE_BEYOND


def _add_pedestal(spec: mujoco.MjSpec, model: mujoco.MjModel, robot: Robot) -> None:
    """Add a pedestal from the floor to the robot's lowest point, unless the robot stands on the
    floor or the table.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    fixed = model.body_weldid[model.geom_bodyid] == 0
    touching = (model.geom_contype | model.geom_conaffinity) > 0
    stand = next(geoms for geoms in (fixed & touching, fixed, touching) if geoms.any())
    placed = [outline(model, data, geom) for geom in np.flatnonzero(stand)]
    x, y = np.mean([(one.max(axis=0) + one.min(axis=0))[:2] / 2 for one in placed], axis=0)
    lowest = min(float(one[:, 2].min()) for one in placed)
    floor = -robot.table.height
    height = lowest - 0.01 - floor
    over_table = abs(x - _table_x(robot)) < robot.table.size[0] / 2
    if height <= 0.02 or (over_table and abs(lowest) < _ON_TABLE):
        return
    spec.worldbody.add_geom(
        name="pedestal",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[_PEDESTAL, _PEDESTAL, height / 2],
        pos=[x, y, floor + height / 2],
        rgba=[0.28, 0.29, 0.32, 1],
    )


def _add_cameras(spec: mujoco.MjSpec, robot: Robot) -> None:
    space = robot.workspace
    scale = max(space.half_width / USUAL, space.height / _SEEN_HEIGHT)
    middle, at = np.array([*space.centre, 0.0]), np.array([*space.centre, _LOOK_AT * scale])
    for name, way in _CAMERAS.items():
        pose = robot.cameras.get(name) or CameraPose(
            tuple(middle + scale * np.array(way)), tuple(at), _FIELD
        )
        spec.worldbody.add_camera(
            name=name, pos=pose.position, quat=pose.quaternion, fovy=pose.fovy
        )
