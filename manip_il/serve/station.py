"""A simulated arm, its world and its leader, advanced by the wall clock, whoever reads when."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.collect.expert import Expert
from manip_il.data.atomic import write_file
from manip_il.errors import UsageError
from manip_il.mdp import State
from manip_il.seeding import rng_for
from manip_il.serve.bus import STEPS, Bus
from manip_il.serve.config import SessionConfig
from manip_il.serve.servo import Follower, Leader, encoder_steps
from manip_il.sim.env import ManipEnv
from manip_il.sim.world import World

F64 = NDArray[np.float64]
FEETECH = "so_follower"  # `robot_type` of the arms whose servos these are, in LeRobot
_SLICES = 4  # times in a control step, at most, that commands reach the motors and registers are written
_LATE = 0.25  # behind the wall clock by more, time is given up [s]
_FULL_TURN = "wrist_roll"  # LeRobot's calibration gives it a whole turn


class Read(NamedTuple):
    """A client's look at the follower.

    told: where it was to go then, by so many commands. sag: how far it hangs below where it is told to be. Both joints
    [rad], (n,).
    """

    state: State
    told: F64
    sag: F64
    commands: int


class Station:
    """Two ports, `follower` and `leader` in a folder, and what is behind them.

    `NAME.json` beside each is a calibration that LeRobot reads; `NAME.eeprom` is what the servos keep. on_read: called,
    from another thread, whenever a client reads where the follower is. mover: who moves the leader: returns its joints
    [rad], (n,), or None to leave them. hand: joints at which a hand holds both arms, and nothing moves. Raises
    `UsageError` for a robot without Feetech servos.
    """

    def __init__(self, env: ManipEnv, config: SessionConfig):
        robot = env.scene.robot
        if robot.lerobot is None or robot.lerobot.robot_type != FEETECH:
            raise UsageError(
                f"--robot.type={robot.name} has no Feetech servos; expected so101, or the YAML of an arm with "
                f"lerobot.robot_type: {FEETECH}"
            )
        env.world = World(replace(env.scene, model=copy.copy(env.scene.model)))  # whose motors become servos
        self.env, self._config = env, config
        self._servos = config.servos.ideal() if config.servo == "ideal" else config.servos
        self._expert = Expert(env.scene)
        self.names = [name.removesuffix(".pos") for name in env.scene.robot.joint_names]
        steps = env.config.physics_steps
        self._slices = next(count for count in range(_SLICES, 0, -1) if steps % count == 0)
        self.slice = 1 / (env.config.control_hz * self._slices)
        ranges = env.scene.model.jnt_range[np.isin(env.scene.model.jnt_qposadr, env.scene.arm_q)]
        self.limits: F64 = np.array([*ranges, sorted(robot.lerobot.gripper)])  # of the servos' joints [rad], (n, 2)
        names = ("follower", "leader")
        self.buses = {name: self._bus(config.output_dir, name) for name in names}
        self.follower = Follower(env.world, self.buses["follower"], self._servos, self.slice)
        self.leader = Leader(self.buses["leader"], env.data.qpos[self.follower.q])
        self.mover: Callable[[], F64 | None] = lambda: None
        self.hand: F64 | None = None
        self.seed, self._solved = 0, 0
        self.on_read: Callable[[Read], None] = lambda read: None
        self._show()
        self.buses["follower"].on_read = self._was_read

    def look(self) -> Read:
        """Return what a client sees now."""
        with self.buses["follower"].lock:
            return Read(self._shown, self.follower.goal(), self._sag, self.buses["follower"].commands)

    @property
    def solved_for(self) -> float:
        """Time for which the task has been solved [s]."""
        return self._solved / self.env.config.control_hz

    def _was_read(self) -> None:
        self.on_read(self.look())

    def _bus(self, folder: Path, name: str) -> Bus:
        folder.mkdir(parents=True, exist_ok=True)
        ranges = [(low, high) for low, high in zip(*map(encoder_steps, self.limits.T), strict=True)]
        ranges = [(0, STEPS - 1) if one == _FULL_TURN else own for one, own in zip(self.names, ranges, strict=True)]
        bus = Bus(ranges, folder / f"{name}.eeprom")
        link = folder / name
        if link.exists() and not link.is_symlink():
            raise UsageError(f"{link} is no link; expected a folder for this command's own, give --output_dir=")
        link.unlink(missing_ok=True)
        link.symlink_to(bus.path)
        if not (file := folder / f"{name}.json").exists():
            write_file(file, json.dumps(self._calibration(bus), indent=4).encode())
        return bus

    def _calibration(self, bus: Bus) -> dict[str, dict[str, int]]:
        """What LeRobot's calibration file of these servos holds."""
        held = {"id": "ID", "homing_offset": "Homing_Offset", "range_min": "Min_Position_Limit"}
        held |= {"range_max": "Max_Position_Limit"}
        servos = zip(self.names, bus.servos, strict=True)
        return {
            name: {"drive_mode": 0} | {key: servo[register] for key, register in held.items()} for name, servo in servos
        }

    def wanted(self) -> F64 | None:
        """Return where the expert would tell the follower to go [rad], beyond by what it sags, (n,); None: no label."""
        label = self._expert.label(self.env.get_state(), self.env.world)
        return self.to_joints(label.action) + self.follower.sag() if label.valid else None

    def expert(self) -> F64 | None:
        """Return where a leader must be for that [rad], (n,), who sees by how much the follower's servos are off."""
        wanted = self.wanted()
        return None if wanted is None else wanted + self.follower.offset

    def reset(self, seed: int) -> None:
        """Draw the world of a seed, the arm at its start, the leader with it."""
        self.env.start(seed)
        self.seed, self._solved = seed, 0
        servos = self._servos.varied(rng_for(seed, "servos")) if self._config.varies else self._servos
        self.follower.reset(servos)
        self.leader.place(self.env.data.qpos[self.follower.q])
        self._show()

    def run(self, each_step: Callable[[], bool]) -> None:
        """Let time pass until `each_step`, called every control step, returns False."""
        begun, slices = time.perf_counter(), 0
        while True:
            begun = self._wait(begun, slices)
            if slices % self._slices == 0:
                if self.hand is None:
                    self.env.begin_step()
                if not each_step():
                    return
                for bus in self.buses.values():
                    bus.keep()
            self._advance(slices % self._slices == self._slices - 1)
            slices += 1

    def _wait(self, begun: float, slices: int) -> float:
        """Wait for the time of a slice; returns the beginning of time, later where the machine is too slow."""
        behind = time.perf_counter() - begun - slices * self.slice
        time.sleep(max(0.0, -behind))
        return begun + behind if behind > _LATE else begun

    def _advance(self, ends_step: bool) -> None:
        """One slice of time."""
        env, most = self.env, self._servos.speed * self.slice
        if self.hand is not None:
            env.data.qpos[self.follower.q] = self.hand
            env.data.qvel[:] = 0.0
            mujoco.mj_forward(env.world.model, env.data)
            self.leader.place(self.hand)
        else:
            wanted = self.mover()
            self.leader.move(self.leader.q if wanted is None else wanted, most)
            self.follower.command()
            mujoco.mj_step(env.world.model, env.data, env.config.physics_steps // self._slices)
            env.world.update()
            if ends_step:
                env.count_step()
                self._solved = self._solved + 1 if env.solved else 0
        self._show()

    def _show(self) -> None:
        """Let clients and cameras see the world as it is."""
        data, state = self.env.data, self.env.get_state()
        self.seen = data.qpos.copy(), data.mocap_pos.copy()
        with self.buses["follower"].lock:
            self.follower.show()
            self._shown, self._sag = state, self.follower.sag()

    def to_joints(self, action: F64) -> F64:
        """Return the joints [rad] that an action (n,) asks for, (n,)."""
        arm, opening = self.env.scene.actions.split(action)
        return np.array([*arm, *self.env.scene.gripper.command(opening)])

    def to_action(self, joints: F64) -> F64:
        """Return the action (n,) that asks for these joints [rad], (n,)."""
        scene, arm = self.env.scene, len(self.env.scene.arm_q)
        return scene.actions.join(joints[:arm], scene.gripper.commanded(joints[arm:], joints[arm:]))

    def close(self) -> None:
        """End the ports, and remove their links."""
        for name, bus in self.buses.items():
            (self._config.output_dir / name).unlink(missing_ok=True)
            bus.close()
