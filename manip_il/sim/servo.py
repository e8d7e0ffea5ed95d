"""How servos move the joints of a simulated arm: a goal that is late and moves at most at a given
speed, gear play, and a position loop with gain, torque limit, damping and friction.

Gravity acts on such an arm. Parameters in the order of `PARAMETERS`.
"""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import F64, I64
from manip_il.robots.robot import Robot
from manip_il.robots.servos import FACTORY_GAIN, GAIN, PARAMETERS, servo_ranges

_DRY = 0.999, 0.9999  # of MuJoCo's friction, which lets joints creep at its default
_SHORT = 0.01  # way from which on friction and play are fully compensated [rad]
_COUNT = len(PARAMETERS)
# rows of a memory after the parameters
_RAMP = _COUNT
_AT = _COUNT + 1
_TOLD = _COUNT + 2
Per = float | F64


def follow(ramp: F64, at: F64, goal: F64, most: Per, play: Per) -> tuple[F64, F64]:
    """Advance goals within servos and what the gears make of them, by one physics step.

    Args:
        ramp: Goals within the servos [rad].
        at: Where the gears are [rad].
        goal: What was commanded [rad].
        most: Longest step of `ramp` [rad].
        play: Half the backlash [rad].

    Returns:
        The new `ramp` and `at`.
    """
    ramp = np.clip(goal, ramp - most, ramp + most)
    return ramp, np.clip(at, ramp - play, ramp + play)


def set_joints(model: mujoco.MjModel, dof: I64, servos: F64) -> None:
    """Give joints the friction and inertia of their servos, and the arm its weight.

    Args:
        model: The arm's model, changed in place.
        dof: The joints' degrees of freedom, (n,).
        servos: Parameters, (n, 8).
    """
    model.body_gravcomp[:] = 0.0
    model.dof_damping[dof] = 0.0  # the servo's own is part of its torque
    model.dof_frictionloss[dof] = servos[:, PARAMETERS.index("friction")]
    model.dof_solimp[dof, :2] = _DRY
    model.dof_armature[dof] = servos[:, PARAMETERS.index("armature")]


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


def dofs_of(model: mujoco.MjModel, q: I64) -> I64:
    """Return the degrees of freedom of joints by their addresses in `qpos`, (n,)."""
    return model.jnt_dofadr[[int((model.jnt_qposadr == one).argmax()) for one in q]]


def memory_size(robot: Robot, step: float) -> int:
    """Return how many numbers an arm's servos remember, if there is a physics step of `step` [s].

    0 if the robot has no servos.
    """
    if not robot.servos:
        return 0
    joints = robot.joint_names
    longest = servo_ranges(robot.servos, joints)[..., PARAMETERS.index("delay")].max()
    return len(joints) * (_TOLD + 1 + math.ceil(longest / step))


class ArmServos:
    """The servos of a compiled arm, in joint order, the gripper last.

    Their parameters, goals and gear play are in MuJoCo's `userdata`, so that a state is whole.

    Attributes:
        q: The joints' addresses in `qpos`, (n,).
        ctrl: Their motors, (n,).
        dof: Their degrees of freedom, (n,).
        ranges: Values of the parameters, and the ends of their ranges, (3, n, 8).
    """

    def __init__(self, robot: Robot, model: mujoco.MjModel, q: I64, ctrl: I64):
        """Find the joints, and give the model the servos' nominal values.

        Args:
            robot: The robot, which has servos.
            model: The compiled model, changed in place.
            q: The joints' addresses in `qpos`, (n,).
            ctrl: Their motors, (n,).
        """
        self.q, self.ctrl = q, ctrl
        self.dof = dofs_of(model, q)
        self.ranges = servo_ranges(robot.servos, robot.joint_names)
        self._step = float(model.opt.timestep)
        self._joints = np.arange(len(q))
        set_joints(model, self.dof, self.ranges[0])

    def draw(self, rng: np.random.Generator, share: float) -> F64:
        """Return parameters (n, 8) from the servos' ranges.

        Args:
            rng: Generator to draw from.
            share: How much of the distance from the values to the drawn ones is gone, 0 to 1.
        """
        values, ends = self.ranges[0], self.ranges[1:]
        return values + share * (rng.uniform(*ends) - values)

    def _memory(self, data: mujoco.MjData) -> F64:
        return data.userdata.reshape(-1, len(self.q))

    def begin(self, model: mujoco.MjModel, data: mujoco.MjData, servos: F64) -> None:
        """Use servos with these parameters (n, 8), at rest at the current joint positions."""
        self._memory(data)[:_COUNT] = servos.T
        self.hold(data)
        self.apply(model, data)

    def apply(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Give a model the servos that its data name, after a state was restored."""
        set_joints(model, self.dof, self._memory(data)[:_COUNT].T)

    def hold(self, data: mujoco.MjData, which: NDArray[np.bool_] | slice = slice(None)) -> None:
        """Make the current positions of joints, of all (n,) by default, their goals since ever."""
        self._memory(data)[_RAMP:, which] = data.qpos[self.q[which]]

    def of(self, data: mujoco.MjData, name: str) -> F64:
        """Return a parameter of every servo, (n,)."""
        return self._memory(data)[PARAMETERS.index(name)]

    def gain(self, data: mujoco.MjData, coefficient: Per = GAIN) -> F64:
        """Return the stiffness of every servo at a P_Coefficient [N m/rad], (n,)."""
        return self.of(data, "stiffness") * coefficient / FACTORY_GAIN

    def _sag(self, model: mujoco.MjModel, data: mujoco.MjData) -> F64:
        """How far the arm's weight pulls joints at rest from their goals [rad], (n,)."""
        mujoco.mj_comPos(model, data)
        joints = model.dof_jntid[self.dof]
        bodies = model.jnt_bodyid[joints]
        arm = data.subtree_com[bodies] - data.xanchor[joints]
        weight = -model.opt.gravity[2] * model.body_subtreemass[bodies]
        torque = weight * np.cross(data.xaxis[joints], arm)[:, 2]
        return torque / self.gain(data)

    def lead(self, model: mujoco.MjModel, data: mujoco.MjData, way: F64) -> F64:
        """Return how far servos must aim beyond where their joints are to go [rad], (n,).

        They hold the arm's weight, and push through friction and gear play.

        Args:
            model: The arm's model.
            data: Its data, with up-to-date kinematics.
            way: How far the joints are to go [rad], (n,).
        """
        dead = self.of(data, "friction") / self.gain(data) + np.radians(self.of(data, "play")) / 2
        return self._sag(model, data) + dead * np.clip(way / _SHORT, -1, 1)

    def command(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        goal: F64,
        gain: F64 | None = None,
        limit: Per = 1.0,
        dead: Per = 0.0,
    ) -> None:
        """Set the motors for one physics step.

        Args:
            model: The arm's own model, changed in place.
            data: Its data.
            goal: What is commanded [rad], (n,).
            gain: Stiffness [N m/rad], (n,); None: at LeRobot's P_Coefficient.
            limit: Share of the torque that is allowed.
            dead: Position errors below which a servo does nothing [rad].
        """
        memory = self._memory(data)
        values = dict(zip(PARAMETERS, memory, strict=False))
        told, q = memory[_TOLD:], data.qpos[self.q]
        told[1:] = told[:-1]
        told[0] = goal
        late = np.rint(values["delay"] / self._step).astype(int)
        goal = told[late, self._joints]
        most, play = values["speed"] * self._step, np.radians(values["play"]) / 2
        ramp, at = follow(memory[_RAMP], memory[_AT], goal, most, play)
        memory[_RAMP], memory[_AT] = ramp, at
        data.ctrl[self.ctrl] = np.where(np.abs(at - q) < dead, q, at)
        gain = self.gain(data) if gain is None else gain
        set_motors(model, self.ctrl, gain, values["damping"], values["torque"] * limit)

    def at(self, data: mujoco.MjData) -> F64:
        """Return where the springs of the servos pull [rad], (n,)."""
        return self._memory(data)[_AT]
