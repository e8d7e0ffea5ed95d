"""A simulated arm, its world and its leader, which advance with the wall clock, whether or not a
client reads them.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from manip_il import checks
from manip_il.data.atomic import write_file
from manip_il.errors import UsageError
from manip_il.mdp import F64, State
from manip_il.robots.table import get_robot
from manip_il.seeding import rng_for
from manip_il.serve.bus import STEPS, Bus, Calibration, encoder_steps
from manip_il.serve.config import SessionConfig
from manip_il.serve.link import Link
from manip_il.serve.servo import Follower, with_servos
from manip_il.sim.conditions import Condition
from manip_il.sim.view import Clock
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.ladder.expert import LadderExpert
from manip_il.worlds.ladder.world import LadderEnv

FEETECH = "so_follower"  # LeRobot's `robot_type` of arms with these servos
TICK = 4  # physics steps between moments at which clients read and write: 8 ms at 480 Hz
OFFSET = np.radians(1.0)  # largest error of an encoder whose servo varies [rad]
HELD = 1.0  # how long the task must stay solved before it counts [s]
_FULL_TURN = "wrist_roll"  # the joint whose range is a full turn in LeRobot's calibration


Mover = Callable[[], F64 | None]


class Read(NamedTuple):
    """The world and the follower when a client reads the follower's position.

    Attributes:
        state: State of the world.
        told: The follower's target after `commands` commands, joint angles [rad], (n,).
        commands: Number of commands that the follower has received.
    """

    state: State
    told: F64
    commands: int


class Seen(NamedTuple):
    """What can be seen of the world at a moment.

    Attributes:
        measured: What the follower's servos measure, as `Follower.measured` returns it.
        state: State of the world.
        scene: `qpos`, `mocap_pos` and `mocap_quat` of MuJoCo, for cameras.
    """

    measured: tuple[F64, F64, F64]
    state: State
    scene: tuple[F64, F64, F64]


class Station:
    """Two ports, `follower` and `leader`, in a folder, and the simulation behind them.

    `NAME.json` beside each port is its calibration in LeRobot's format: the registers that the
    servos keep without power.

    Attributes:
        env: The simulated environment.
        seed: Seed of the current world.
        clock: Paces the moments at which clients read and write.
        limits: The servos' joint limits [rad], (n, 2).
        buses: The servos of `follower` and of `leader`.
        follower: The follower's servos as motors of the simulated arm.
        mover: Called every control step; returns the joints to which the weightless leader moves
            [rad], (n,), or None if it stays.
        hand: Joint angles at which a hand holds both arms still [rad], (n,), or None.
        on_read: Called, from another thread, whenever a client reads the follower's position.
        seen: What the cameras see: `qpos`, `mocap_pos` and `mocap_quat` of MuJoCo.
    """

    def __init__(
        self, named: EnvConfig, config: SessionConfig, conditions: Sequence[Condition] = ()
    ):
        """Open the ports and draw the world of seed 0.

        Args:
            named: The environment to simulate; its motors become servos.
            config: Options of the session.
            conditions: How worlds vary.

        Raises:
            UsageError: If the robot has no Feetech servos.
        """
        robot = get_robot(named.robot)
        if robot.lerobot is None or robot.lerobot.robot_type != FEETECH:
            raise UsageError(
                f"--robot.type={robot.name} has no Feetech servos; expected so101, or the YAML of"
                f" an arm with lerobot.robot_type: {FEETECH}"
            )
        env = LadderEnv(named, None, conditions, with_servos(robot, config.servo))
        servos = env.scene.servos
        assert servos is not None
        self.env, self._config = env, config
        # what states of the environment that was named do not have
        self._beyond = 0 if robot.servos else env.scene.model.nuserdata
        self._expert = LadderExpert(env.scene)
        self._step = 1 / env.config.control_hz  # [s]
        moments = env.config.control_hz * env.config.physics_steps / TICK  # a second
        self.clock, self._ticks = Clock(moments * config.speed), 0
        ranges = env.scene.model.jnt_range[np.isin(env.scene.model.jnt_qposadr, env.scene.arm_q)]
        # the servos' joint limits [rad], (n, 2)
        self.limits: F64 = np.array([*ranges, sorted(robot.lerobot.gripper)])
        self.buses = {name: self._open(name) for name in ("follower", "leader")}
        self.follower = Follower(env.world, servos, self.buses["follower"])
        self.mover: Mover = lambda: None
        self.hand: F64 | None = None
        self.on_read: Callable[[Read], None] = lambda read: None
        self.reset(0)
        self.buses["follower"].on_read = lambda: self.on_read(self.look())

    def _open(self, name: str) -> Bus:
        """Open a port, with its link and its calibration in the folder."""
        link = self._config.output_dir / name
        link.parent.mkdir(parents=True, exist_ok=True)
        kept: Calibration = {}
        for number, (label, limits) in enumerate(
            zip(self.env.scene.robot.joint_names, self.limits, strict=True), 1
        ):
            joint = label.removesuffix(".pos")
            low, high = (0, STEPS - 1) if joint == _FULL_TURN else encoder_steps(limits)
            kept[joint] = {"id": number, "homing_offset": 0, "range_min": low, "range_max": high}
        file = link.with_suffix(".json")
        bus = Bus(checks.read_json(file, "a calibration") if file.exists() else kept)
        self._keep(link, bus)
        link.unlink(missing_ok=True)
        link.symlink_to(bus.path)
        return bus

    def _keep(self, link: Path, bus: Bus) -> None:
        write_file(link.with_suffix(".json"), json.dumps(bus.calibration, indent=4).encode())

    def look(self) -> Read:
        """Return the world and the follower as a client reads them now."""
        with self.buses["follower"].lock:
            return Read(self._shown, self.follower.goal(), self.buses["follower"].commands)

    def as_named(self, state: State) -> State:
        """Return a state as the environment that was named has it, perhaps without servos."""
        return replace(state, physics=state.physics[: len(state.physics) - self._beyond])

    @property
    def is_solved(self) -> bool:
        """Whether the task has been solved for `HELD` seconds."""
        return self._solved >= HELD * self.env.config.control_hz

    def expert(self) -> F64 | None:
        """Return the joints [rad], (n,), to which the expert moves the leader.

        None if the state has no valid label.

        These are the label's joints plus the offset of the follower's servos.
        """
        label = self._expert.label(self.env.get_state(), self.env)
        return self.to_joints(label.action) + self.follower.offset if label.valid else None

    def reset(self, seed: int) -> None:
        """Draw the world of a seed; follower and leader are at its start posture."""
        self.env.start(seed)
        self.seed, self._solved = seed, 0
        world, servos = self.env.world, self.follower.servos
        robot = self.env.scene.robot
        offset = -np.radians([robot.zeros.get(name, 0.0) for name in robot.plain_names])
        if self._config.varies:
            servos.begin(world.model, world.data, servos.draw(rng_for(seed, "servos"), 1.0))
            offset = offset + rng_for(seed, "encoders").uniform(-OFFSET, OFFSET, len(offset))
        self.follower.reset(offset)
        self._place_leader(self.follower.q)
        self._views = Link(self._config, self._look(), rng_for(seed, "views"))
        self._orders = Link(self._config, self.follower.goal(), rng_for(seed, "orders"))
        self._ordered = self.follower.goal()
        self._show()

    def run(self, each_step: Callable[[], bool]) -> None:
        """Run the simulation until `each_step`, called every control step, returns False."""
        while each_step():
            self._advance()

    def _advance(self) -> None:
        """Advance the simulation by one control step."""
        env = self.env
        if self.hand is not None:
            env.data.qpos[self.follower.servos.q] = self.hand
            env.data.qvel[:] = 0.0
            mujoco.mj_forward(env.world.model, env.data)
            self._place_leader(self.hand)
            for _ in range(env.config.physics_steps):
                self._tick()
        else:
            self._move_leader(self.mover())
            env.simulate(self._tick)
            self._solved = self._solved + 1 if env.solved else 0

    def _tick(self) -> None:
        """Command the motors for a physics step, once it is time for it."""
        now = self._ticks * self.env.config.physics_step
        if self._ticks % TICK == 0:
            goal = self.follower.goal()
            if (goal != self._ordered).any():
                self._orders.send(now, goal)
                self._ordered = goal
            self._views.send(now, self._look())
            self._show()
            self.clock.wait()
        self._ticks += 1
        self.follower.command(self._orders.receive(now))

    def _place_leader(self, q: F64) -> None:
        self._leader = q.copy()
        self.buses["leader"].show(q, settled=True)

    def _move_leader(self, q: F64 | None) -> None:
        """Move joints towards `q` at up to the servos' speed.

        Those with torque on move to their goals instead.
        """
        bus = self.buses["leader"]
        most = self.follower.servos.of(self.env.data, "speed") * self._step
        wanted = np.where(bus["Torque_Enable"] > 0, bus.goals(), self._leader if q is None else q)
        self._leader = self._leader + np.clip(wanted - self._leader, -most, most)
        bus.show(self._leader)

    def _look(self) -> Seen:
        # shown without a knock that may follow
        data, state = self.env.data, replace(self.env.get_state(), begun=True)
        scene = data.qpos.copy(), data.mocap_pos.copy(), data.mocap_quat.copy()
        return Seen(self.follower.measured(), state, scene)

    def _show(self) -> None:
        """Update what clients and cameras see."""
        arrived = self._views.receive(self._ticks * self.env.config.physics_step)
        self.seen = arrived.scene
        with self.buses["follower"].lock:
            self.buses["follower"].show(*arrived.measured)
            self._shown = arrived.state

    def to_joints(self, action: F64) -> F64:
        """Return the joints [rad], (n,), that an action (n,) commands."""
        arm, opening = self.env.scene.actions.split(action)
        return np.array([*arm, *self.env.scene.gripper.command(opening)])

    def to_action(self, joints: F64) -> F64:
        """Return the action (n,) that commands these joints [rad], (n,)."""
        scene, arm = self.env.scene, len(self.env.scene.arm_q)
        return scene.actions.join(joints[:arm], scene.gripper.commanded(joints[arm:]))

    def close(self) -> None:
        """Save the calibrations, close the ports, and remove their links."""
        for name, bus in self.buses.items():
            link = self._config.output_dir / name
            self._keep(link, bus)
            link.unlink(missing_ok=True)
            bus.close()
