"""How an STS3215 moves a joint: a goal that is late and moves at most at a given speed, gear play,
and a position loop with gain, torque limit, damping and friction.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from manip_il import checks
from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import F64, I64
from manip_il.option import check_bounds
from manip_il.seeding import rng_for
from manip_il.serve.bus import STEP, Bus
from manip_il.serve.config import (
    FACTORY_GAIN,
    IDEAL,
    STRONG,
    STS3215,
    ServoConfig,
    SessionConfig,
)
from manip_il.sim.world import World

_DRY = 0.999, 0.9999  # of MuJoCo's friction, which lets joints creep at its default
Per = float | F64
Servos = Mapping[str, F64]  # parameters of `ServoConfig` by name, (n,) each
PARAMETERS = tuple(field.name for field in fields(ServoConfig) if field.name != "offset")
_HAND = 100.0  # stiffness of a hand that holds an arm whose torque is off [N m/rad]


def set_joints(model: mujoco.MjModel, dof: I64, friction: Per, armature: Per) -> None:
    """Give joints the friction and inertia of their servos, and the arm its weight.

    Args:
        model: The arm's model, changed in place.
        dof: The joints' degrees of freedom, (n,).
        friction: Dry friction [N m], (n,) or one for all.
        armature: Inertia of motor and gears at the joint [kg m^2], likewise.
    """
    model.body_gravcomp[:] = 0.0
    model.dof_damping[dof] = 0.0  # the servo's own is part of its torque
    model.dof_frictionloss[dof] = friction
    model.dof_solimp[dof, :2] = _DRY
    model.dof_armature[dof] = armature


def set_motors(model: mujoco.MjModel, ctrl: I64, gain: Per, damping: Per, torque: Per) -> None:
    """Give motors the position loop of servos.

    Args:
        model: The arm's model, changed in place.
        ctrl: The motors, (n,).
        gain: Torque per position error at the gain in use [N m/rad], (n,) or one for all.
        damping: Torque against the motion [N m s/rad], likewise.
        torque: Largest torque [N m], likewise.
    """
    model.actuator_gainprm[ctrl, 0] = gain
    model.actuator_biasprm[ctrl, 1] = -np.asarray(gain)
    model.actuator_biasprm[ctrl, 2] = -np.asarray(damping)
    model.actuator_forcerange[ctrl, 0] = -np.asarray(torque)
    model.actuator_forcerange[ctrl, 1] = torque


def draw_servos(config: SessionConfig, joints: Sequence[str], seed: int) -> Servos:
    """Return the servos of the world of a seed.

    Args:
        config: Options of the session: which servos, and whether they differ from world to world,
            by `VARIED` or, if they come from a file, within its intervals.
        joints: Names of the joints, as LeRobot has them.
        seed: Seed of the world.

    Raises:
        UnknownName: If there are no such servos.
        UsageError: If the file is wrong.
    """
    rng = rng_for(seed, "servos")
    if isinstance(config.servo, Path):
        values, *interval = read_servos(config.servo, joints)
        if config.varies:
            values = rng.uniform(*interval)
        return dict(zip(PARAMETERS, values.T, strict=True)) | {"offset": np.zeros(len(joints))}
    if config.servo not in (STS3215, STRONG):
        raise UnknownName("servo", config.servo, (STS3215, STRONG, "a file servos.yaml"))
    servos = replace(config.servos, **IDEAL) if config.servo == STRONG else config.servos
    if config.varies:
        servos = servos.varied(rng)
    return {name: np.full(len(joints), value) for name, value in asdict(servos).items()}


def read_servos(path: Path, joints: Sequence[str]) -> F64:
    """Read servos, which `robot identify` writes as YAML: joint, parameter, [value, low, high].

    Args:
        path: The file.
        joints: Names of the joints, as LeRobot has them.

    Returns:
        Values, lower and upper ends, parameters in the order of `PARAMETERS`, (3, n, 8).

    Raises:
        UsageError: If a joint or a parameter is missing, or a value is out of its bounds.
    """
    tree = checks.mapping("servos", checks.read_yaml(path, "a file of servos"))
    rows: list[Any] = []
    for joint in joints:
        name = joint.removesuffix(".pos")
        own = checks.mapping(f"{path}: {name}", tree.get(name))
        triples = [own.get(parameter) for parameter in PARAMETERS]
        for parameter, triple in zip(PARAMETERS, triples, strict=True):
            if not isinstance(triple, list) or len(triple) != 3:
                raise UsageError(
                    f"{path}: {parameter} of {name} is {triple}; expected [value, low, high]"
                )
        rows.append(triples)
        for values in zip(*triples, strict=True):
            check_bounds(ServoConfig(**dict(zip(PARAMETERS, values, strict=True))))
    return np.moveaxis(np.array(rows, float), -1, 0)


class Follower:
    """The servos of a bus as the motors of a simulated arm, in joint order, the gripper last.

    Gravity acts on the arm. A servo whose torque is off keeps its position, as if a hand held it.

    Attributes:
        q: The joints' addresses in `qpos`, (n,).
    """

    def __init__(self, world: World, bus: Bus, step: float):
        """Connect a bus to an arm; call `reset` before `command`.

        Args:
            world: The world with the arm.
            bus: The servos' registers.
            step: Time between calls of `command` [s].
        """
        scene, model = world.scene, world.scene.model
        self._world = world
        self._bus = bus
        self._step = step
        self.q = np.array([*scene.arm_q, *scene.gripper.q])
        self._ctrl = np.array([*scene.arm_ctrl, *scene.gripper.ctrl])
        self._dof = model.jnt_dofadr[
            [int(np.flatnonzero(model.jnt_qposadr == q)[0]) for q in self.q]
        ]
        self._at = self._ramp = np.zeros(len(self.q))
        self._on = np.zeros(len(self.q), bool)

    def reset(self, servos: Servos) -> None:
        """Use servos with these parameters; the current joint positions become their goals."""
        self.servos = servos
        for model in (self._world.scene.model, self._world.model):
            set_joints(model, self._dof, servos["friction"], servos["armature"])
        self._at = self._ramp = self._world.data.qpos[self.q]
        self._late = np.rint(servos["delay"] / self._step).astype(int)
        self._told = np.tile(self._at, (self._late.max() + 1, 1))  # the last goals, newest first
        self._bus.show(self._at + self.offset, settled=True)

    @property
    def offset(self) -> F64:
        """Encoder angles minus joint angles [rad], (n,)."""
        return np.radians(self.servos["offset"])

    def _gain(self) -> F64:
        """Return the stiffness of every servo at its current gain [N m/rad], (n,)."""
        return self.servos["stiffness"] * np.maximum(1, self._bus["P_Coefficient"]) / FACTORY_GAIN

    def sag(self) -> F64:
        """Return how far the joints are from their goals at rest under gravity [rad], (n,)."""
        return self._world.data.qfrc_bias[self._dof] / self._gain()

    def goal(self) -> F64:
        """Return the servos' last goals as joint angles, without the encoders' offset [rad],
        (n,).
        """
        return self._bus.goals() - self.offset

    def command(self) -> None:
        """Set the motors from the registers; call this every `step` seconds."""
        data = self._world.data
        model = self._world.model
        bus = self._bus
        q = data.qpos[self.q]
        with bus.lock:
            on = bus["Torque_Enable"] > 0
            gain = self._gain()
            goal = self.goal()
            dead = STEP * bus["CW_Dead_Zone"]
            limit = np.minimum(bus["Max_Torque_Limit"], bus["Torque_Limit"]) / 1000
        self._told = np.roll(self._told, 1, axis=0)
        self._told[0] = goal
        goal = self._told[self._late, np.arange(len(goal))]
        most = self.servos["speed"] * self._step
        ramp = self._ramp + np.clip(goal - self._ramp, -most, most)
        play = np.radians(self.servos["play"]) / 2
        led = np.clip(self._at, ramp - play, ramp + play)
        # torque off: stay where it was turned off
        self._at = np.where(on, led, np.where(self._on, q, self._at))
        self._ramp = np.where(on, ramp, self._at)
        self._on = on
        data.ctrl[self._ctrl] = np.where(on & (np.abs(self._at - q) < dead), q, self._at)
        gain = np.where(on, gain, _HAND)
        most = self.servos["torque"] * np.where(on, limit, 1.0)
        set_motors(model, self._ctrl, gain, self.servos["damping"], most)

    def show(self) -> None:
        """Write what the servos measure into their registers."""
        data = self._world.data
        load = data.actuator_force[self._ctrl] / self.servos["torque"]
        self._bus.show(data.qpos[self.q] + self.offset, data.qvel[self._dof], load)
