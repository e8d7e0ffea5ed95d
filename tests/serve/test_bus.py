"""The serial protocol and the registers, as Feetech's servos have them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from manip_il.serve.bus import CENTRE, Bus

BROADCAST = 0xFE
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83
LIMITS = [(800, 3300)] * 6


def packet(number: int, instruction: int, *parameters: int) -> bytes:
    body = bytes([number, len(parameters) + 2, instruction, *parameters])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Bus]:
    bus = Bus(LIMITS, tmp_path / "arm.eeprom")
    yield bus
    bus.close()


@pytest.mark.parametrize("value", [0, 1, -1, 2047, -2047])
def test_a_negative_number_is_sign_and_magnitude(bus: Bus, value: int):
    servo = bus.servos[0]
    servo["Homing_Offset"] = value
    assert servo["Homing_Offset"] == value
    assert int.from_bytes(servo.memory[31:33], "little") == abs(value) | (0x800 if value < 0 else 0)


def test_every_servo_answers_a_broadcast_and_an_absent_one_nothing(bus: Bus):
    assert bus.feed(packet(BROADCAST, PING)) == b"".join(packet(number, 0) for number in range(1, 7))
    assert bus.feed(packet(3, PING)) == packet(3, 0)
    assert bus.feed(packet(9, PING)) == b""


def test_a_servo_says_that_it_is_an_sts3215(bus: Bus):
    assert bus.feed(packet(1, READ, 3, 2)) == packet(1, 0, 777 & 0xFF, 777 >> 8)


def test_position_is_the_encoder_less_the_offset(bus: Bus):
    servo = bus.servos[0]
    servo["Homing_Offset"] = -100
    servo.show(CENTRE)
    assert servo["Present_Position"] == CENTRE + 100
    servo["Goal_Position"] = CENTRE + 100
    assert servo.goal == CENTRE


def test_a_goal_stays_within_the_limits(bus: Bus):
    bus.servos[0]["Goal_Position"] = 4000
    assert bus.servos[0].goal == LIMITS[0][1]


def test_sync_write_tells_several_servos_at_once_and_sync_read_asks_them(bus: Bus):
    assert bus.feed(packet(BROADCAST, SYNC_WRITE, 42, 2, 1, 0x10, 0x08, 2, 0x20, 0x08)) == b""
    assert [servo.goal for servo in bus.servos[:2]] == [0x810, 0x820]
    assert bus.feed(packet(BROADCAST, SYNC_READ, 42, 2, 2, 1)) == packet(2, 0, 0x20, 0x08) + packet(1, 0, 0x10, 0x08)


def test_what_a_servo_measures_cannot_be_written(bus: Bus):
    bus.servos[0].show(CENTRE)
    bus.feed(packet(1, WRITE, 56, 0, 0))
    assert bus.servos[0]["Present_Position"] == CENTRE


def test_limits_and_offsets_outlive_the_session_and_the_torque_does_not(tmp_path: Path):
    bus = Bus(LIMITS, tmp_path / "arm.eeprom")
    bus.feed(packet(2, WRITE, 31, 7, 0) + packet(2, WRITE, 40, 1))
    bus.close()
    again = Bus(LIMITS, tmp_path / "arm.eeprom")
    assert again.servos[1]["Homing_Offset"] == 7
    assert not again.servos[1]["Torque_Enable"]
    again.close()


def test_garbage_is_not_answered_and_what_follows_is(bus: Bus):
    """Noise, halves of packets, wrong checksums, 10,000 times: only whole right ones are answered, in the end all."""
    asked, rng = packet(1, READ, 3, 2), np.random.default_rng(0)
    right = packet(1, 0, 777 & 0xFF, 777 >> 8)
    for _ in range(10_000):
        noise = rng.integers(0, 255, rng.integers(0, 24), dtype=np.uint8).tobytes()  # no 255: no head of a packet
        wrong = asked[:-1] + bytes([asked[-1] ^ int(rng.integers(1, 256))])
        half = asked[: int(rng.integers(0, len(asked)))]
        found = b"".join(bus.feed(part) for part in (noise, wrong, half, asked * 4))
        assert found
        assert found == right * (len(found) // len(right))


_OPENER = """
import sys
from serial import Serial
port = Serial(sys.argv[1], timeout=float(sys.argv[2]))
port.write(bytes.fromhex(sys.argv[3]))
print(port.read(6).hex(), flush=True)
sys.stdin.readline()
"""


def opener(bus: Bus, patience: float) -> subprocess.Popen[str]:
    """A program that opens the port, pings, prints the answer, and closes the port when it is told to."""
    words = [sys.executable, "-c", _OPENER, str(bus.path), str(patience), packet(1, PING).hex()]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_of_two_programs_on_a_port_the_second_gets_no_answer(bus: Bus):
    """And who comes after both is answered again, also if they ended at once, which the kernel makes one event."""
    refused, answer = list[str](), packet(1, 0).hex() + "\n"
    bus.on_refusal = refused.append
    with opener(bus, 2.0) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == answer
        with opener(bus, 0.3) as second:
            assert second.stdout is not None
            assert second.stdout.readline() == "\n"
            for one in (first, second):
                one.kill()
    assert "another program" in refused[0]
    with opener(bus, 2.0) as third:
        assert third.stdout is not None
        assert third.stdout.readline() == answer
        third.kill()
