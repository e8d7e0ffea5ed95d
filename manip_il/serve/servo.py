"""How an STS3215 moves a joint: a goal that is late and moves at most at a given speed, gear play,
and a position loop with gain, torque limit, damping and friction.
"""

import math
from collections import deque

import numpy as np

from manip_il.mdp import F64
from manip_il.serve.bus import STEP, Bus
from manip_il.serve.config import FACTORY_GAIN, ServoConfig
from manip_il.sim.world import World

_DRY = 0.999, 0.9999  # of MuJoCo's friction, which lets joints creep at its default
_HAND = 100.0  # stiffness of a hand that holds an arm whose torque is off [N m/rad]


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
        self._coming = deque[F64]()

    def reset(self, config: ServoConfig) -> None:
        """Use servos with these parameters; the current joint positions become their goals."""
        self.config = config
        for model in (self._world.scene.model, self._world.model):
            model.body_gravcomp[:] = 0.0
            model.dof_damping[self._dof] = 0.0  # the servo's own is part of its torque
            model.dof_frictionloss[self._dof] = config.friction
            model.dof_solimp[self._dof, :2] = _DRY
            model.dof_armature[self._dof] = config.armature
        self._at = self._ramp = self._world.data.qpos[self.q]
        self._coming = deque([self._at] * round(config.delay / self._step))
        self._bus.show(self._at + self.offset, settled=True)

    @property
    def offset(self) -> float:
        """Encoder angle minus joint angle [rad]."""
        return math.radians(self.config.offset)

    def _gain(self) -> F64:
        """Return the stiffness of every servo at its current gain [N m/rad], (n,)."""
        return self.config.stiffness * np.maximum(1, self._bus["P_Coefficient"]) / FACTORY_GAIN

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
        self._coming.append(goal)
        goal = self._coming.popleft()
        most = self.config.speed * self._step
        ramp = self._ramp + np.clip(goal - self._ramp, -most, most)
        play = math.radians(self.config.play) / 2
        led = np.clip(self._at, ramp - play, ramp + play)
        # torque off: stay where it was turned off
        self._at = np.where(on, led, np.where(self._on, q, self._at))
        self._ramp = np.where(on, ramp, self._at)
        self._on = on
        data.ctrl[self._ctrl] = np.where(on & (np.abs(self._at - q) < dead), q, self._at)
        gain = np.where(on, gain, _HAND)
        model.actuator_gainprm[self._ctrl, 0] = gain
        damping = np.full(len(gain), self.config.damping)
        model.actuator_biasprm[self._ctrl, 1:3] = -np.stack([gain, damping], axis=1)
        most = self.config.torque * np.where(on, limit, 1.0)
        model.actuator_forcerange[self._ctrl] = np.stack([-most, most], axis=1)

    def show(self) -> None:
        """Write what the servos measure into their registers."""
        data = self._world.data
        load = data.actuator_force[self._ctrl] / self.config.torque
        self._bus.show(data.qpos[self.q] + self.offset, data.qvel[self._dof], load)
