"""The servos of a bus as the motors of a simulated arm."""

from dataclasses import replace

import numpy as np

from manip_il.errors import UsageError
from manip_il.mdp import F64
from manip_il.robots import NAMED_SERVOS
from manip_il.robots.robot import Robot
from manip_il.robots.servos import servos_of
from manip_il.serve.bus import STEP, Bus
from manip_il.sim.servo import ArmServos
from manip_il.sim.world import World

_HAND = 100.0  # stiffness of a hand that holds an arm whose torque is off [N m/rad]


def with_servos(robot: Robot, name: str) -> Robot:
    """Return a robot with servos: its YAML's own, or those that are named.

    Args:
        robot: The robot.
        name: A name in `NAMED_SERVOS`; empty for its own, or the first of these if it has none.

    Raises:
        UnknownName: If there are no such servos.
        UsageError: If the robot has servos of its own and others are named.
    """
    if not robot.servos:
        return replace(robot, servos=servos_of(name or NAMED_SERVOS[0], robot.joint_names))
    if name:
        raise UsageError(f"{robot.name} has servos in its YAML; leave out --servo")
    return robot


class Follower:
    """The servos of a bus as the motors of a simulated arm, in joint order, the gripper last.

    Gravity acts on the arm. A servo whose torque is off keeps its position, as if a hand held it.

    Attributes:
        servos: The arm's servos.
        offset: Encoder angles minus joint angles [rad], (n,).
    """

    def __init__(self, world: World, servos: ArmServos, bus: Bus):
        """Connect a bus to an arm; call `reset` before `command`.

        Args:
            world: The world with the arm.
            servos: The arm's servos, whose parameters its state holds.
            bus: The servos' registers.
        """
        self.servos = servos
        self._world = world
        self._bus = bus
        self.offset = np.zeros(len(servos.q))
        self._on = np.zeros(len(servos.q), bool)

    def reset(self, offset: F64) -> None:
        """Show the current joint positions, which become the goals, with errors of the encoders
        [rad], (n,).
        """
        self.offset = offset
        self._bus.show(self.q + offset, settled=True)

    @property
    def q(self) -> F64:
        """Joint positions [rad], (n,)."""
        return self._world.data.qpos[self.servos.q]

    def goal(self) -> F64:
        """Return the servos' last goals as joint angles, without the encoders' offset [rad],
        (n,).
        """
        return self._bus.goals() - self.offset

    def command(self, goal: F64) -> None:
        """Set the motors from the registers; call this before every physics step.

        Args:
            goal: The goals that have arrived [rad], (n,).
        """
        servos, bus = self.servos, self._bus
        data = self._world.data
        with bus.lock:
            on = bus["Torque_Enable"] > 0
            gain = servos.gain(data, np.maximum(1, bus["P_Coefficient"]))
            dead = STEP * bus["CW_Dead_Zone"]
            limit = np.minimum(bus["Max_Torque_Limit"], bus["Torque_Limit"]) / 1000
        if (off := self._on & ~on).any():
            servos.hold(data, off)
        self._on = on
        servos.command(
            self._world.model,
            data,
            np.where(on, goal, servos.at(data)),
            np.where(on, gain, _HAND),
            np.where(on, limit, 1.0),
            np.where(on, dead, 0.0),
        )

    def measured(self) -> tuple[F64, F64, F64]:
        """Return positions [rad], speeds [rad/s] and loads that the servos measure, (n,) each."""
        data, servos = self._world.data, self.servos
        load = data.actuator_force[servos.ctrl] / servos.of(data, "torque")
        return self.q + self.offset, data.qvel[servos.dof].copy(), load
