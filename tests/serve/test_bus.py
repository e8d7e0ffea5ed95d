"""The serial protocol and the registers, as Feetech's servos have them."""

import contextlib
import os
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from manip_il.serve.bus import STEP, Bus, Calibration, encoder_steps

BROADCAST = 0xFE
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83
KEPT: Calibration = {
    f"joint_{number}": {"id": number, "homing_offset": 0, "range_min": 800, "range_max": 3300}
    for number in range(1, 7)
}
CENTRE = np.zeros(6)  # where encoders read 2048 [rad]


def packet(number: int, instruction: int, *parameters: int) -> bytes:
    body = bytes([number, len(parameters) + 2, instruction, *parameters])
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus(KEPT)
    yield bus
    bus.close()


@pytest.mark.parametrize("value", [0, 1, -1, 2047, -2047])
def test_a_negative_number_is_sign_and_magnitude(bus: Bus, value: int):
    bus["Homing_Offset"] = value
    assert (bus["Homing_Offset"] == value).all()
    assert int.from_bytes(bus.memory[0, 31:33], "little") == abs(value) | (
        0x800 if value < 0 else 0
    )


def test_every_servo_answers_a_broadcast_and_an_absent_one_nothing(bus: Bus):
    assert bus.feed(packet(BROADCAST, PING)) == b"".join(
        packet(number, 0) for number in range(1, 7)
    )
    assert bus.feed(packet(3, PING)) == packet(3, 0)
    assert bus.feed(packet(9, PING)) == b""


def test_position_is_the_encoder_less_the_offset(bus: Bus):
    bus["Homing_Offset"] = -100
    bus.show(CENTRE)
    assert (bus["Present_Position"] == 2048 + 100).all()
    bus["Goal_Position"] = 2048 + 100
    assert (bus.goals() == CENTRE).all()


def test_a_goal_stays_within_the_limits(bus: Bus):
    bus["Goal_Position"] = 4000
    assert (encoder_steps(bus.goals()) == 3300).all()


def test_sync_write_tells_several_servos_at_once_and_sync_read_asks_them(bus: Bus):
    assert bus.feed(packet(BROADCAST, SYNC_WRITE, 42, 2, 1, 0x10, 0x08, 2, 0x20, 0x08)) == b""
    assert bus.goals()[:2] == pytest.approx([16 * STEP, 32 * STEP])
    assert bus.feed(packet(BROADCAST, SYNC_READ, 42, 2, 2, 1)) == packet(2, 0, 0x20, 0x08) + packet(
        1, 0, 0x10, 0x08
    )


def test_what_a_servo_measures_cannot_be_written(bus: Bus):
    bus.show(CENTRE)
    bus.feed(packet(1, WRITE, 56, 0, 0))
    assert bus["Present_Position"][0] == 2048


def test_limits_and_offsets_are_kept_without_power_and_the_torque_is_not(bus: Bus):
    bus.feed(packet(2, WRITE, 31, 7, 0) + packet(2, WRITE, 40, 1))
    again = Bus(bus.calibration)
    assert again["Homing_Offset"].tolist() == [0, 7, 0, 0, 0, 0]
    assert not again["Torque_Enable"].any()
    again.close()


def test_a_client_that_asks_without_reading_does_not_keep_the_port_open():
    bus = Bus(KEPT)
    client = os.open(bus.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    asked, deadline = packet(BROADCAST, SYNC_READ, 0, 70, 1, 2, 3, 4, 5, 6), time.monotonic() + 1
    while time.monotonic() < deadline:
        with contextlib.suppress(BlockingIOError):
            os.write(client, asked * 50)
    closing = threading.Thread(target=bus.close, daemon=True)
    closing.start()
    closing.join(20)
    assert not closing.is_alive()
    os.close(client)


def test_garbage_is_not_answered_and_what_follows_is(bus: Bus):
    """Noise, halves of packets, wrong checksums, 10,000 times: only whole right ones are
    answered, in the end all.
    """
    asked, rng = packet(1, READ, 3, 2), np.random.default_rng(0)
    right = packet(1, 0, 777 & 0xFF, 777 >> 8)
    for _ in range(10_000):
        # no 255: no head of a packet
        noise = rng.integers(0, 255, rng.integers(0, 24), dtype=np.uint8).tobytes()
        wrong = asked[:-1] + bytes([asked[-1] ^ int(rng.integers(1, 256))])
        half = asked[: int(rng.integers(0, len(asked)))]
        found = b"".join(bus.feed(part) for part in (noise, wrong, half, asked * 4))
        assert found
        assert found == right * (len(found) // len(right))
