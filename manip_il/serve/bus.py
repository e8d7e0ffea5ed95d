"""A chain of Feetech STS3215 servos behind a pseudo-terminal: their serial protocol, in LeRobot's own tables.

A packet is `FF FF id length instruction parameters checksum`; an answer has an error byte in place of the instruction.
The checksum is the complement of the sum of all bytes from the id on. Present_Position = encoder - Homing_Offset.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import pty
import select
import struct
import threading
import tty
from collections.abc import Callable, Sequence
from pathlib import Path

from lerobot.motors.encoding_utils import decode_sign_magnitude, encode_sign_magnitude
from lerobot.motors.feetech import tables
from scservo_sdk import scservo_def as protocol

_MODEL = "sts3215"
_TABLE, _SIGNS = tables.MODEL_CONTROL_TABLE[_MODEL], tables.MODEL_ENCODING_TABLE[_MODEL]
STEPS: int = tables.MODEL_RESOLUTION[_MODEL]  # of the encoder in a turn
CENTRE = STEPS // 2  # of the encoder where a joint is at zero
_HEAD = b"\xff\xff"
_SIZE = 96  # bytes of a servo's memory that can be read
_EEPROM = range(5, 40)  # what a servo keeps without power
_READ_ONLY = {*range(5), *range(56, 71)}
_LONGEST = 250  # of a packet's length byte
_POSITION: int = _TABLE["Present_Position"][0]
_FACTORY = {  # what a new servo holds
    "Firmware_Major_Version": 3,
    "Firmware_Minor_Version": 10,
    "Model_Number": tables.MODEL_NUMBER_TABLE[_MODEL],
    "Max_Torque_Limit": 1000,  # a thousandth of the stall torque
    "Torque_Limit": 1000,
    "P_Coefficient": 32,
    "D_Coefficient": 32,
    "CW_Dead_Zone": 1,
    "CCW_Dead_Zone": 1,
    "Present_Voltage": 120,  # a tenth of a volt
    "Present_Temperature": 30,  # degrees Celsius
}


class Servo:
    """One servo: numbers by the names that LeRobot has for its registers. limits: of its position [encoder steps]."""

    def __init__(self, number: int, limits: tuple[int, int]):
        self.memory = bytearray(_SIZE)
        own = {"ID": number, "Min_Position_Limit": limits[0], "Max_Position_Limit": limits[1]}
        for name, value in (_FACTORY | own).items():
            self[name] = value

    def __getitem__(self, name: str) -> int:
        address, size = _TABLE[name]
        value = int.from_bytes(self.memory[address : address + size], "little")
        return decode_sign_magnitude(value, _SIGNS[name]) if name in _SIGNS else value

    def __setitem__(self, name: str, value: int) -> None:
        address, size = _TABLE[name]
        raw = encode_sign_magnitude(value, _SIGNS[name]) if name in _SIGNS else value
        self.memory[address : address + size] = raw.to_bytes(size, "little")

    def store(self, address: int, values: bytes) -> None:
        """Take what was written to its memory; read-only places stay as they are."""
        for place, value in enumerate(values, address):
            if place < _SIZE and place not in _READ_ONLY:
                self.memory[place] = value

    @property
    def goal(self) -> int:
        """The encoder's reading that it was told to go to, within its limits."""
        low, high, goal = self["Min_Position_Limit"], self["Max_Position_Limit"], self["Goal_Position"]
        return (min(max(goal, low), high) if low < high else goal) + self["Homing_Offset"]

    def aim(self, encoder: int) -> None:
        """Set its goal, as an encoder's reading."""
        self["Goal_Position"] = encoder - self["Homing_Offset"]

    def show(self, encoder: int, velocity: float = 0.0, load: float = 0.0) -> None:
        """Set what it measures: the encoder's reading, steps a second, and the share of its stall torque, -1 to 1."""
        self["Present_Position"] = encoder - self["Homing_Offset"]
        self["Present_Velocity"] = round(velocity)
        self["Present_Load"] = round(1000 * load)
        self["Moving"] = int(abs(velocity) > 10)
        self["Present_Current"] = round(400 * abs(load))  # steps of 6.5 mA, of 2.7 A at stall


class Bus:
    """Servos that answer on a pseudo-terminal, from a thread of its own.

    path: to be opened by any program that speaks to serial ports. lock: is held while a packet is answered; hold it to
    read or write the servos. connected: servos that are on the bus, all unless it is set. commands: how often several
    were told something at once. on_read: called with the lock held when one packet has asked several servos where they
    are: a step of a client. on_refusal: called with a line that says why a client gets no answer. eeprom: a file that
    keeps ids, limits and offsets; it is read first, where it is there.
    """

    def __init__(self, limits: Sequence[tuple[int, int]], eeprom: Path):
        self.servos = [Servo(number, limit) for number, limit in enumerate(limits, 1)]
        self.lock = threading.RLock()
        self.connected: set[Servo] | None = None
        self.commands = 0
        self.on_read: Callable[[], None] = lambda: None
        self.on_refusal: Callable[[str], None] = lambda line: None
        self._eeprom, self._changed, self._waiting = eeprom, False, b""
        if eeprom.is_file():
            for servo, kept in zip(self.servos, json.loads(eeprom.read_text()), strict=True):
                servo.memory[_EEPROM.start : _EEPROM.stop] = bytes.fromhex(kept)
        self._master, self._slave = pty.openpty()  # our hold on the other end keeps the port open between two clients
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = Path(os.ttyname(self._slave))
        self._opened = _Opened(self.path)
        self._stop_reading, self._stop = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"bus {eeprom.stem}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, and the port with it."""
        os.write(self._stop, b".")
        self._thread.join()
        self.keep()
        for one in (self._master, self._slave, self._stop, self._stop_reading):
            os.close(one)
        self._opened.close()

    def keep(self) -> None:
        """Write what the servos keep to the file, if a client has changed it: not while one waits for an answer."""
        with self.lock:
            changed, self._changed = self._changed, False
            kept = [servo.memory[_EEPROM.start : _EEPROM.stop].hex() for servo in self.servos]
        if changed:
            partial = self._eeprom.with_suffix(".partial")
            partial.write_text(json.dumps(kept, indent=1))
            partial.replace(self._eeprom)

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._master, self._stop_reading], [], [])
            if self._stop_reading in ready:
                return
            os.write(self._master, self.feed(os.read(self._master, 4096)))

    def feed(self, received: bytes) -> bytes:
        """Return the answers to all packets that are whole with these bytes; what comes after them waits for more.

        What is no packet, or has a wrong checksum, is skipped a byte at a time, as what follows may be one.
        """
        answers, self._waiting = b"", self._waiting + received
        while (begin := self._waiting.find(_HEAD)) >= 0:
            self._waiting = line = self._waiting[begin:]
            if len(line) < 4:
                break
            number, length, body = line[2], line[3], line[2 : 3 + line[3]]
            sound = number != 0xFF and 2 <= length <= _LONGEST
            if sound and len(line) < 4 + length:
                break
            if not sound or line[3 + length] != _checksum(body):
                self._waiting = line[1:]
                continue
            self._waiting = line[4 + length :]
            with self.lock:
                answers += self._answer(number, body[2], body[3:])
        else:
            self._waiting = self._waiting[-1:]
        return answers

    def _answer(self, number: int, instruction: int, parameters: bytes) -> bytes:
        here = {one["ID"]: one for one in self.servos if self.connected is None or one in self.connected}
        if instruction == protocol.INST_PING:
            asked = here if number == protocol.BROADCAST_ID else here.keys() & {number}
            return b"" if self._is_shared() else b"".join(_packet(one) for one in asked)
        if instruction == protocol.INST_SYNC_READ and len(parameters) >= 2:
            address, size, *asked = parameters
            if address <= _POSITION < address + size and len(asked) > 1:
                self.on_read()
            return b"".join(_packet(one, _memory(here[one], address, size)) for one in asked if one in here)
        if instruction == protocol.INST_SYNC_WRITE and len(parameters) >= 2:
            self.commands += 1
            address, size, *rest = parameters
            for place in range(0, len(rest) - size, size + 1):
                if rest[place] in here:
                    here[rest[place]].store(address, bytes(rest[place + 1 : place + 1 + size]))
        elif instruction == protocol.INST_READ and number in here and len(parameters) == 2:
            return _packet(number, _memory(here[number], *parameters))
        elif instruction == protocol.INST_WRITE and number in here and parameters:
            here[number].store(parameters[0], parameters[1:])
            self._changed |= parameters[0] in _EEPROM and not here[number]["Lock"]
            return _packet(number)
        return b""

    def _is_shared(self) -> bool:
        """Return whether two other programs have the port open: who pings then comes second."""
        if shared := self._opened.count() > 1:
            self.on_refusal(f"{self.path} is open in another program already: the second gets no answer")
        return shared


def _memory(servo: Servo, address: int, size: int) -> bytes:
    return bytes(servo.memory[address : address + size]).ljust(size, b"\0")


def _packet(number: int, parameters: bytes = b"") -> bytes:
    """An answer without an error."""
    body = bytes([number, len(parameters) + 2, 0]) + parameters
    return _HEAD + body + bytes([_checksum(body)])


def _checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF


class _Opened:
    """Counts by how many other programs a file is open: by Linux's inotify, which is quick."""

    _OPEN, _CLOSE = 0x20, 0x08 | 0x10
    _EVENT = struct.Struct("iIII")

    def __init__(self, path: Path):
        self._path, self._count, libc = str(path), 0, ctypes.CDLL(None)
        self._events: int = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        libc.inotify_add_watch(self._events, bytes(path), self._OPEN | self._CLOSE)

    def count(self) -> int:
        """Return by how many it is open now."""
        with contextlib.suppress(OSError):  # nothing has happened
            while happened := os.read(self._events, 4096):
                for _, mask, _, _ in self._EVENT.iter_unpack(happened):
                    self._count += bool(mask & self._OPEN) - bool(mask & self._CLOSE)
        if self._count > 1:  # or two that closed it at once were one event
            self._count = len({file.parent for file in Path("/proc").glob("[0-9]*/fd/*") if self._is_at(file)}) - 1
        return self._count

    def _is_at(self, file: Path) -> bool:
        with contextlib.suppress(OSError):
            return os.readlink(file) == self._path
        return False

    def close(self) -> None:
        """Stop counting."""
        os.close(self._events)
