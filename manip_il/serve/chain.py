"""A chain of Feetech STS3215 servos: their serial protocol, and the registers that LeRobot uses.

A packet is `FF FF id length instruction parameters checksum`; an answer has an error byte in place of the instruction.
The checksum is the complement of the sum of all bytes from the id on. Addresses are those of the memory table of the
STS3215 (Feetech), as `lerobot.motors.feetech.tables` has them. Present_Position = encoder - Homing_Offset.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence

STEPS = 4096  # of the encoder in a turn
CENTRE = 2048  # of the encoder where a joint is at zero
BROADCAST = 0xFE
_PING, _READ, _WRITE, _SYNC_READ, _SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83
_HEAD = b"\xff\xff"
_SIZE = 96  # bytes of a servo's memory that can be read
EEPROM = range(5, 40)  # what a servo keeps without power
_LONGEST = 250  # of a packet's length byte
_ID, _LOCK = 5, 55


class Register:
    """A number in a servo's memory. sign: the bit that says it is negative, None for what cannot be."""

    def __init__(self, address: int, size: int = 1, sign: int | None = None):
        self.address, self.size, self.sign = address, size, sign

    def read(self, memory: bytearray) -> int:
        """Return its value."""
        value = int.from_bytes(memory[self.address : self.address + self.size], "little")
        if self.sign is not None and value >> self.sign & 1:
            return -(value & (1 << self.sign) - 1)
        return value

    def write(self, memory: bytearray, value: int) -> None:
        """Set its value."""
        raw = value if value >= 0 or self.sign is None else -value | 1 << self.sign
        memory[self.address : self.address + self.size] = (raw & (1 << 8 * self.size) - 1).to_bytes(self.size, "little")


MIN_POSITION, MAX_POSITION = Register(9, 2), Register(11, 2)
MAX_TORQUE, P_GAIN = Register(16, 2), Register(21)
DEAD_ZONE = Register(26)
HOMING_OFFSET = Register(31, 2, 11)
TORQUE_ENABLE = Register(40)
GOAL, TORQUE_LIMIT = Register(42, 2, 15), Register(48, 2)
POSITION, VELOCITY, LOAD = Register(56, 2, 15), Register(58, 2, 15), Register(60, 2, 10)
_MOVING, _CURRENT = Register(66), Register(69, 2)
_READ_ONLY = {*range(5), *range(56, 71)}
_FACTORY = {  # what a new servo holds; 777 is an STS3215, and its firmware is 3.10
    Register(0): 3,
    Register(1): 10,
    Register(3, 2): 777,
    Register(7): 250,
    Register(8): 1,
    Register(13): 70,  # degrees Celsius at most
    Register(14): 140,  # a tenth of a volt
    Register(15): 40,
    MAX_TORQUE: 1000,  # a thousandth of the stall torque
    P_GAIN: 32,
    Register(22): 32,
    Register(24, 2): 16,
    DEAD_ZONE: 1,
    Register(27): 1,
    Register(28, 2): 500,
    TORQUE_LIMIT: 1000,
    Register(62): 120,  # 12 V
    Register(63): 30,  # degrees Celsius
}


class Servo:
    """The memory of one servo. limits: of its position, in encoder steps."""

    def __init__(self, number: int, limits: tuple[int, int]):
        self.memory = bytearray(_SIZE)
        for register, value in (_FACTORY | {Register(_ID): number}).items():
            register.write(self.memory, value)
        MIN_POSITION.write(self.memory, limits[0])
        MAX_POSITION.write(self.memory, limits[1])

    @property
    def number(self) -> int:
        """Id on the bus."""
        return self.memory[_ID]

    def store(self, address: int, values: bytes) -> None:
        """Take what was written to its memory; read-only places stay as they are."""
        for place, value in enumerate(values, address):
            if place < _SIZE and place not in _READ_ONLY:
                self.memory[place] = value

    @property
    def has_torque(self) -> bool:
        """Whether its motor is on."""
        return bool(TORQUE_ENABLE.read(self.memory))

    @property
    def goal(self) -> int:
        """The encoder's reading that it was told to go to, within its limits."""
        low, high = MIN_POSITION.read(self.memory), MAX_POSITION.read(self.memory)
        goal = GOAL.read(self.memory)
        return (min(max(goal, low), high) if low < high else goal) + HOMING_OFFSET.read(self.memory)

    def aim(self, encoder: int) -> None:
        """Set its goal, as an encoder's reading."""
        GOAL.write(self.memory, encoder - HOMING_OFFSET.read(self.memory))

    def show(self, encoder: int, velocity: float = 0.0, load: float = 0.0) -> None:
        """Set what it measures: the encoder's reading, steps a second, and the share of its stall torque, -1 to 1."""
        POSITION.write(self.memory, encoder - HOMING_OFFSET.read(self.memory))
        VELOCITY.write(self.memory, round(velocity))
        LOAD.write(self.memory, round(1000 * load))
        _MOVING.write(self.memory, int(abs(velocity) > 10))
        _CURRENT.write(self.memory, round(400 * abs(load)))  # steps of 6.5 mA, of 2.7 A at stall


class Chain:
    """Servos that answer to packets.

    lock: is held while a packet is answered; hold it to read or write the servos' memories. connected: servos that are
    on the bus, all unless it is set. commands: how often several were told something at once. eeprom_changed: whether
    a client has changed what they keep. on_read: called with the lock held when one packet has asked several servos
    where they are: a step of a client.
    """

    def __init__(self, limits: Sequence[tuple[int, int]]):
        self.servos = [Servo(number, limit) for number, limit in enumerate(limits, 1)]
        self.lock = threading.RLock()
        self.connected: set[Servo] | None = None
        self.commands, self.eeprom_changed = 0, False
        self.on_read: Callable[[], None] = lambda: None

    def answers(self, received: bytes) -> Iterator[tuple[bytes, bytes]]:
        """Yield the answer of every whole packet, empty for one that has none, and the bytes that follow it.

        The last bytes are those of a packet that is still coming. What is no packet, or has a wrong checksum, is
        skipped a byte at a time, as what follows may be one.
        """
        while (begin := received.find(_HEAD)) >= 0 and len(received) >= begin + 4:
            received = received[begin:]
            number, length = received[2], received[3]
            if number == 0xFF or not 2 <= length <= _LONGEST:
                received = received[1:]
                continue
            if len(received) < 4 + length:
                break
            body, check = received[2 : 3 + length], received[3 + length]
            if ~sum(body) & 0xFF != check:
                received = received[1:]
                continue
            received = received[4 + length :]
            with self.lock:
                answer = self._answer(body[0], body[2], body[3:])
            yield answer, received
        yield b"", received if _HEAD in received else received[-1:]

    def _answer(self, number: int, instruction: int, parameters: bytes) -> bytes:
        here = {one.number: one for one in self.servos if self.connected is None or one in self.connected}
        if instruction == _PING:
            return b"".join(_packet(one) for one in (here if number == BROADCAST else here.keys() & {number}))
        if instruction == _SYNC_READ and number == BROADCAST and len(parameters) >= 2:
            address, size, *asked = parameters
            if address <= POSITION.address < address + size and len(asked) > 1:
                self.on_read()
            return b"".join(_packet(one, _memory(here[one], address, size)) for one in asked if one in here)
        if instruction == _SYNC_WRITE and number == BROADCAST and len(parameters) >= 2:
            self.commands += 1
            address, size, *rest = parameters
            for place in range(0, len(rest) - size, size + 1):
                if rest[place] in here:
                    here[rest[place]].store(address, bytes(rest[place + 1 : place + 1 + size]))
            return b""
        if number not in here:
            return b""
        servo = here[number]
        if instruction == _READ and len(parameters) == 2:
            return _packet(number, _memory(servo, *parameters))
        if instruction == _WRITE and parameters:
            servo.store(parameters[0], parameters[1:])
            if parameters[0] in EEPROM and not servo.memory[_LOCK]:
                self.eeprom_changed = True
            return _packet(number)
        return b""

    def calibration(self, names: Sequence[str]) -> dict[str, dict[str, int]]:
        """Return what LeRobot's calibration file of these servos holds. names: of the servos, in their order."""
        return {
            name: {
                "id": servo.number,
                "drive_mode": 0,
                "homing_offset": HOMING_OFFSET.read(servo.memory),
                "range_min": MIN_POSITION.read(servo.memory),
                "range_max": MAX_POSITION.read(servo.memory),
            }
            for name, servo in zip(names, self.servos, strict=True)
        }


def _memory(servo: Servo, address: int, size: int) -> bytes:
    return bytes(servo.memory[address : address + size]).ljust(size, b"\0")


def _packet(number: int, parameters: bytes = b"") -> bytes:
    """An answer without an error."""
    body = bytes([number, len(parameters) + 2, 0]) + parameters
    return _HEAD + body + bytes([~sum(body) & 0xFF])
