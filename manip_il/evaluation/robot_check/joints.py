"""How position control moves and holds each joint, from home."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.scene import PREFIX
from manip_il.sim.world import Scene

F64 = NDArray[np.float64]
LOAD = 0.2  # in the hand [kg]
_SECONDS = 1.0  # of each step response, and of holding
_RISE = (0.1, 0.9)  # shares of a step between which its rise is timed


@dataclass(frozen=True)
class JointFacts:
    """One joint of the arm; of a joint that slides, m and N stand for rad and N m.

    limits: [rad], None where it turns freely. home [rad]. kp [N m/rad], kv [N m s/rad], force: the greatest [N m].
    rise: from a tenth to nine tenths of the longest step of its target [s], None where that takes over a second.
    overshoot: beyond that step, as its share. sag: off home under `LOAD` in the hand [rad].
    """

    name: str
    slides: bool
    limits: tuple[float, float] | None
    home: float
    kp: float
    kv: float
    force: float
    rise: float | None
    overshoot: float
    sag: float


@dataclass(frozen=True)
class ArmFacts:
    """Joints base to hand. own_motors: names of the model's own actuators, which position control replaces.

    bodies: from the base to the one of the frame `ee`.
    step: of a joint's target in its response [rad]. sag: of the hand under `LOAD` [m].
    """

    joints: tuple[JointFacts, ...]
    bodies: tuple[str, ...]
    own_motors: tuple[str, ...]
    step: float
    sag: float


def arm_facts(scene: Scene) -> ArmFacts:
    """Return what every joint of a scene's arm does, alone, from home, the gripper open."""
    robot = scene.robot
    sags, sag = _sags(scene)
    joints = tuple(_joint(scene, place, sags[place]) for place in range(len(robot.joints)))
    files = [one for one in (robot.files, robot.gripper.files) if one is not None]
    specs = [one.load(robot.name) for one in files]  # held: what MuJoCo gives of a model does not keep it
    motors = tuple(motor.name for spec in specs for motor in spec.actuators)
    return ArmFacts(joints, _chain(scene), motors, robot.max_joint_step, sag)


def at_home(scene: Scene) -> mujoco.MjData:
    """Return the physics of a scene with the arm at home and the gripper open, commanded to stay so."""
    data, gripper = mujoco.MjData(scene.model), scene.gripper
    data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = scene.robot.home
    data.qpos[gripper.q] = data.ctrl[gripper.ctrl] = gripper.command(gripper.most)
    mujoco.mj_forward(scene.model, data)
    return data


def _joint(scene: Scene, place: int, sag: float) -> JointFacts:
    robot, model = scene.robot, scene.model
    joint, motor = model.joint(PREFIX + robot.joints[place]), int(scene.arm_ctrl[place])
    limits = (float(joint.range[0]), float(joint.range[1])) if joint.limited[0] else None
    home = robot.home[place]
    upwards = limits is None or limits[1] - home >= home - limits[0]
    response = _step_response(scene, place, robot.max_joint_step if upwards else -robot.max_joint_step)
    low, high = (_first(response >= share) for share in _RISE)
    rise = None if high is None or low is None else (high - low) * model.opt.timestep
    return JointFacts(
        name=robot.joints[place],
        slides=int(joint.type[0]) == mujoco.mjtJoint.mjJNT_SLIDE,
        limits=limits,
        home=home,
        kp=float(model.actuator_gainprm[motor, 0]),
        kv=-float(model.actuator_biasprm[motor, 2]),
        force=float(model.actuator_forcerange[motor, 1]),
        rise=rise,
        overshoot=max(0.0, float(response.max()) - 1.0),
        sag=sag,
    )


def _step_response(scene: Scene, place: int, step: float) -> F64:
    """Return the share of a step of one joint's target that is gone at each physics step, (t,)."""
    data = at_home(scene)
    begin = data.qpos[scene.arm_q[place]]
    data.ctrl[scene.arm_ctrl[place]] = begin + step
    gone = np.empty(round(_SECONDS / scene.model.opt.timestep))
    for moment in range(len(gone)):
        mujoco.mj_step(scene.model, data)
        gone[moment] = (data.qpos[scene.arm_q[place]] - begin) / step
    return gone


def _sags(scene: Scene) -> tuple[F64, float]:
    """Return how far off home each joint comes to rest under the load (arm,) [rad], and how far the hand sinks [m]."""
    model, data = scene.model, at_home(scene)
    weight, no_torque = LOAD * model.opt.gravity, np.zeros(3)
    ee, load = data.site_xpos[scene.ee_site].copy(), np.zeros(model.nv)
    body = int(model.site_bodyid[scene.ee_site])
    mujoco.mj_applyFT(model, data, weight, no_torque, ee, body, load)
    data.qfrc_applied[:] = load
    mujoco.mj_step(model, data, round(_SECONDS / model.opt.timestep))
    mujoco.mj_kinematics(model, data)
    sunk = float(ee[2] - data.site_xpos[scene.ee_site][2])
    return np.abs(data.qpos[scene.arm_q] - np.asarray(scene.robot.home)), sunk


def _first(there: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(there)) if there.any() else None


def _chain(scene: Scene) -> tuple[str, ...]:
    """Return the names of the bodies from the base to the frame `ee`'s."""
    model, names = scene.model, list[str]()
    body = int(model.site_bodyid[scene.ee_site])
    while body:
        names.append(model.body(body).name.removeprefix(PREFIX))
        body = int(model.body_parentid[body])
    return tuple(reversed(names))
