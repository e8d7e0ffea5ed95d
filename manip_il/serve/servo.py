"""How an STS3215 moves a joint: a position loop with its gain, torque, speed, gear play and delay."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from manip_il.serve.bus import CENTRE, STEPS, Bus
from manip_il.serve.config import ServoConfig
from manip_il.sim.world import World

F64 = NDArray[np.float64]
STEP = 2 * math.pi / STEPS  # of the encoder [rad]
_FACTORY_GAIN = 32  # P_Coefficient of a new servo, for which `stiffness` is said
_HAND = 100.0  # stiffness of a hand that holds an arm whose torque is off [N m/rad]


class Follower:
    """The servos of a bus as the motors of a simulated arm, joint by joint, the gripper last.

    Gravity pulls at the arm. A servo whose torque is off keeps its place, as if a hand held it.
    """

    def __init__(self, world: World, bus: Bus, config: ServoConfig, step: float):
        scene, model = world.scene, world.scene.model
        self._world, self._bus, self.config, self._step = world, bus, config, step
        self.q = np.array([*scene.arm_q, *scene.gripper.q])
        self._ctrl = np.array([*scene.arm_ctrl, *scene.gripper.ctrl])
        self._dof = model.jnt_dofadr[[int(np.flatnonzero(model.jnt_qposadr == q)[0]) for q in self.q]]
        self._at, self._on, self._coming = np.zeros(len(self.q)), np.zeros(len(self.q), bool), deque[F64]()
        self.reset(config)

    def reset(self, config: ServoConfig) -> None:
        """Take these servos, standing where the joints are."""
        self.config = config
        for model in (self._world.scene.model, self._world.model):
            model.body_gravcomp[model.jnt_bodyid[:]] = 0.0
            model.dof_damping[self._dof] = config.torque / config.speed  # as the motor's own voltage grows
            model.dof_frictionloss[self._dof] = config.friction
        self._at = self._world.data.qpos[self.q]
        self._coming = deque([self._at] * round(config.delay / self._step))
        _place(self._bus, self.encoder())

    def _registers(self, name: str) -> F64:
        with self._bus.lock:
            return np.array([servo[name] for servo in self._bus.servos], float)

    @property
    def offset(self) -> float:
        """Angle by which the encoders read beyond the joints [rad]."""
        return math.radians(self.config.offset)

    @property
    def gain(self) -> F64:
        """Stiffness of every servo at the gain that it was given [N m/rad], (n,)."""
        return self.config.stiffness * np.maximum(1, self._registers("P_Coefficient")) / _FACTORY_GAIN

    def encoder(self) -> list[int]:
        """Return what the encoders read."""
        return encoder_steps(self._world.data.qpos[self.q] + self.offset)

    def sag(self) -> F64:
        """Return how far the joints are from their goals under gravity, at rest [rad], (n,)."""
        return self._world.data.qfrc_bias[self._dof] / self.gain

    def goal(self) -> F64:
        """Return the joints that the servos were told last to go to [rad], (n,)."""
        with self._bus.lock:
            return _joints([one.goal for one in self._bus.servos]) - self.offset

    def command(self) -> None:
        """Give the motors what the registers say: once every `step` seconds."""
        data, model = self._world.data, self._world.model
        q = data.qpos[self.q]
        with self._bus.lock:
            on, gain, goal = self._registers("Torque_Enable") > 0, self.gain, self.goal()
            dead = STEP * self._registers("CW_Dead_Zone")
            limit = np.minimum(self._registers("Max_Torque_Limit"), self._registers("Torque_Limit")) / 1000
        self._coming.append(goal)
        goal = self._coming.popleft()
        play = math.radians(self.config.play) / 2
        led = np.clip(self._at, goal - play, goal + play)
        self._at = np.where(on, led, np.where(self._on, q, self._at))  # without torque: where it was turned off
        self._on = on
        data.ctrl[self._ctrl] = np.where(on & (np.abs(self._at - q) < dead), q, self._at)
        gain = np.where(on, gain, _HAND)
        model.actuator_gainprm[self._ctrl, 0] = gain
        model.actuator_biasprm[self._ctrl, 1:3] = np.stack([-gain, np.zeros(len(gain))], axis=1)
        most = self.config.torque * np.where(on, limit, 1.0)
        model.actuator_forcerange[self._ctrl] = np.stack([-most, most], axis=1)

    def show(self) -> None:
        """Write what the servos measure into their registers."""
        data = self._world.data
        velocity = data.qvel[self._dof] / STEP
        load = data.actuator_force[self._ctrl] / self.config.torque
        with self._bus.lock:
            for servo, *measured in zip(self._bus.servos, self.encoder(), velocity, load, strict=True):
                servo.show(*measured)


class Leader:
    """An arm of servos without a world: its joints go, as fast as servos turn, where somebody moves them.

    With torque on they go to what is written to them, as when a program hands over.
    """

    def __init__(self, bus: Bus, q: F64):
        self._bus = bus
        self.place(q)

    def place(self, q: F64) -> None:
        """Put the joints there at once [rad], (n,)."""
        self.q = np.array(q)
        _place(self._bus, encoder_steps(self.q))

    def move(self, q: F64, most: float) -> None:
        """Move the joints towards `q` by at most so much each [rad]; those with torque on, to their goals."""
        with self._bus.lock:
            goals = _joints([one.goal for one in self._bus.servos])
            wanted = np.where([one["Torque_Enable"] > 0 for one in self._bus.servos], goals, q)
            self.q = self.q + np.clip(wanted - self.q, -most, most)
            for servo, encoder in zip(self._bus.servos, encoder_steps(self.q), strict=True):
                servo.show(encoder)


def encoder_steps(q: F64) -> list[int]:
    """Return what encoders read of joints that stand at `q` [rad], (n,)."""
    return [int(one) for one in np.rint(CENTRE + np.asarray(q) / STEP)]


def _joints(encoder: Sequence[int]) -> F64:
    return (np.array(encoder) - CENTRE) * STEP


def _place(bus: Bus, encoder: Sequence[int]) -> None:
    """Let servos stand, and be told to stand, there."""
    with bus.lock:
        for servo, at in zip(bus.servos, encoder, strict=True):
            servo.show(at)
            servo.aim(at)
