"""A chain of Feetech STS3215 servos behind a pseudo-terminal: their serial protocol, from LeRobot's
own tables.

A packet is `FF FF id length instruction parameters checksum`; an answer has an error byte in place
of the instruction. The checksum is the complement of the sum of all bytes from the id on.
Present_Position = encoder - Homing_Offset.
"""

import contextlib
import math
import os
import pty
import select
import threading
import tty
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from lerobot.motors.feetech import tables
from numpy.typing import ArrayLike, NDArray
from scservo_sdk import scservo_def as protocol

from manip_il.mdp import F64, I64

U8 = NDArray[np.uint8]
_MODEL = "sts3215"
_TABLE, _SIGNS = tables.MODEL_CONTROL_TABLE[_MODEL], tables.MODEL_ENCODING_TABLE[_MODEL]
STEPS: int = tables.MODEL_RESOLUTION[_MODEL]  # encoder steps per turn
STEP = 2 * math.pi / STEPS  # angle per encoder step [rad]
_CENTRE = STEPS // 2  # encoder value at joint angle zero
_HEAD = b"\xff\xff"
_SIZE = 96  # readable bytes of a servo's memory
_READ_ONLY = {*range(5), *range(56, 71)}
_ID, _POSITION = (_TABLE[name][0] for name in ("ID", "Present_Position"))
_KEPT = {  # registers kept without power, by key in LeRobot's calibration file
    "id": "ID",
    "homing_offset": "Homing_Offset",
    "range_min": "Min_Position_Limit",
    "range_max": "Max_Position_Limit",
}
_FACTORY = {  # register values of a new servo
    "Firmware_Major_Version": 3,
    "Firmware_Minor_Version": 10,
    "Model_Number": tables.MODEL_NUMBER_TABLE[_MODEL],
    "Max_Torque_Limit": 1000,  # [0.1 % of the stall torque]
    "Torque_Limit": 1000,
    "P_Coefficient": 32,
    "CW_Dead_Zone": 1,
    "Present_Voltage": 120,  # [0.1 V]
    "Present_Temperature": 30,  # [degrees Celsius]
}
Calibration = dict[str, dict[str, int]]


class Bus:
    """Servos on a pseudo-terminal; a thread of their own answers packets.

    `bus[NAME]` has the values of one register of all servos, (n,), by LeRobot's NAME.

    Attributes:
        path: Device file, for any program that uses serial ports.
        memory: Memory of each servo as bytes, (n, 96).
        lock: Held while a packet is answered; hold it to read several registers at the same moment.
        commands: Number of sync writes received.
        on_read: Called when one packet reads the positions of several servos, which a client does
            once per control step.
    """

    def __init__(self, calibration: Calibration):
        """Open the pseudo-terminal and start the thread.

        Args:
            calibration: The registers that the servos keep without power, by joint name.
        """
        self._names = list(calibration)
        self.memory = np.zeros((len(calibration), _SIZE), np.uint8)
        for name, value in _FACTORY.items():
            self[name] = value
        for key, name in _KEPT.items():
            self[name] = [kept[key] for kept in calibration.values()]
        self.lock = threading.RLock()
        self.commands = 0
        self.on_read: Callable[[], None] = lambda: None
        self._waiting = b""
        # keeping the other end open keeps the port alive between clients
        self._master, self._slave = pty.openpty()
        os.set_blocking(self._master, False)
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = Path(os.ttyname(self._slave))
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __getitem__(self, name: str) -> I64:
        address, size = _TABLE[name]
        values = self.memory[:, address : address + size] @ 256 ** np.arange(size)
        sign = 1 << _SIGNS[name] if name in _SIGNS else 1 << 16
        return np.where(values & sign, -(values & ~sign), values)

    def __setitem__(self, name: str, values: ArrayLike) -> None:
        address, size = _TABLE[name]
        whole = np.broadcast_to(np.rint(values).astype(int), len(self.memory))
        whole = np.abs(whole) | (whole < 0) << _SIGNS.get(name, 0)
        self.memory[:, address : address + size] = whole[:, None] >> 8 * np.arange(size) & 0xFF

    @property
    def calibration(self) -> Calibration:
        """The registers that the servos keep without power, in the format of LeRobot's
        calibration file.
        """
        kept = {"drive_mode": np.zeros(len(self._names), int)} | {
            key: self[name] for key, name in _KEPT.items()
        }
        return {
            name: {key: int(kept[key][joint]) for key in kept}
            for joint, name in enumerate(self._names)
        }

    def goals(self) -> F64:
        """Return the servos' last goals, clipped to their limits [rad], (n,)."""
        with self.lock:
            low = self["Min_Position_Limit"]
            high = self["Max_Position_Limit"]
            goal = self["Goal_Position"]
            encoder = np.where(low < high, np.clip(goal, low, high), goal) + self["Homing_Offset"]
        return np.asarray((encoder - _CENTRE) * STEP, float)

    def show(
        self, q: F64, velocity: ArrayLike = 0.0, load: ArrayLike = 0.0, *, settled: bool = False
    ) -> None:
        """Set what the servos measure.

        Args:
            q: Encoder angles [rad], (n,).
            velocity: Velocities [rad/s], (n,) or one for all.
            load: Loads as shares of the stall torque, -1 to 1, (n,) or one for all.
            settled: Whether to set the servos' goals to these angles, too.
        """
        with self.lock:
            self["Present_Position"] = encoder_steps(q) - self["Homing_Offset"]
            self["Present_Velocity"] = np.asarray(velocity) / STEP
            self["Present_Load"] = 1000 * np.asarray(load)
            if settled:
                self["Goal_Position"] = self["Present_Position"]

    def close(self) -> None:
        """Stop the thread and close the port."""
        self._closing.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _run(self) -> None:
        while not self._closing.is_set():
            if select.select([self._master], [], [], 0.1)[0]:
                # a client that reads no answers loses them
                with contextlib.suppress(BlockingIOError):
                    os.write(self._master, self.feed(os.read(self._master, 4096)))

    def feed(self, received: bytes) -> bytes:
        """Return the answers to all packets that these bytes complete.

        Keep the rest for the next call.

        Invalid data, including packets with a wrong checksum, is skipped byte by byte, as a packet
        may begin anywhere.
        """
        answers = b""
        self._waiting += received
        while (begin := self._waiting.find(_HEAD)) >= 0:
            self._waiting = line = self._waiting[begin:]
            end = 3 + line[3] if len(line) > 3 else len(line)
            body = line[2:end]
            is_sound = 0xFF not in line[2:4]  # neither id nor length
            if is_sound and len(line) <= end:
                break
            if not is_sound or line[end] != _checksum(body):
                self._waiting = line[1:]
                continue
            self._waiting = line[end + 1 :]
            with self.lock:
                answers += self._answer([*body])
        else:
            self._waiting = self._waiting[-1:]
        return answers

    def _answer(self, body: list[int]) -> bytes:
        """Return the answer to a packet, from its id on without the checksum.

        B"" if none is due.
        """
        here = {int(servo[_ID]): servo for servo in self.memory}
        match body:
            case [number, _, protocol.INST_PING]:
                return b"".join(
                    _packet(one) for one in here if number in (one, protocol.BROADCAST_ID)
                )
            case [_, _, protocol.INST_SYNC_READ, address, size, *asked]:
                if address <= _POSITION < address + size and len(asked) > 1:
                    self.on_read()
                return b"".join(
                    _packet(one, _part(here[one], address, size)) for one in asked if one in here
                )
            case [_, _, protocol.INST_SYNC_WRITE, address, size, *rest]:
                self.commands += 1
                for place in range(0, len(rest) - size, size + 1):
                    if rest[place] in here:
                        _store(here[rest[place]], address, rest[place + 1 : place + 1 + size])
            case [number, _, protocol.INST_READ, address, size] if number in here:
                return _packet(number, _part(here[number], address, size))
            case [number, _, protocol.INST_WRITE, address, *values] if number in here:
                _store(here[number], address, values)
                return _packet(number)
            case _:
                pass
        return b""


def encoder_steps(q: F64) -> I64:
    """Return the encoder values of joints at angles `q` [rad], (n,)."""
    return np.rint(_CENTRE + q / STEP).astype(int)


def _part(memory: U8, address: int, size: int) -> bytes:
    return memory[address : address + size].tobytes().ljust(size, b"\0")


def _store(memory: U8, address: int, values: Iterable[int]) -> None:
    """Write values to a servo's memory, except to read-only addresses."""
    for place, value in enumerate(values, address):
        if place < _SIZE and place not in _READ_ONLY:
            memory[place] = value


def _packet(number: int, parameters: bytes = b"") -> bytes:
    """Return an answer packet whose error byte is 0."""
    body = bytes([number, len(parameters) + 2, 0]) + parameters
    return _HEAD + body + bytes([_checksum(body)])


def _checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF
