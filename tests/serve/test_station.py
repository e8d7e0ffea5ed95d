"""A simulated arm behind its ports: LeRobot's own drivers, unmodified, and what the world does
meanwhile.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.robots.so_follower import SO101Follower, SOFollowerRobotConfig
from lerobot.teleoperators.so_leader import SO101Leader, SOLeaderTeleopConfig

from manip_il.cli.main import main
from manip_il.errors import UsageError
from manip_il.serve.config import SessionConfig
from manip_il.serve.link import Link
from manip_il.serve.station import Station
from manip_il.worlds.table import make_config

from ..cli.made_runs import files


def station_of(folder: Path, robot: str = "so101", **session: Any) -> Station:
    station = Station(make_config(robot, "lift"), SessionConfig(output_dir=folder, **session))
    station.reset(1)
    return station


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    station = station_of(tmp_path)
    yield station
    station.close()


def run(station: Station, seconds: float) -> None:
    """Let time pass, as fast as the machine can."""
    steps = iter(range(round(seconds * station.env.config.control_hz)))
    station.clock.wait = lambda: None
    station.run(lambda: next(steps, None) is not None)


def test_an_arm_without_feetech_servos_is_refused(tmp_path: Path):
    with pytest.raises(UsageError, match="panda has no Feetech servos"):
        station_of(tmp_path, robot="panda")


@pytest.mark.parametrize("which", ["output_dir", "log"])
def test_somebodys_folder_is_not_served_from(which: str, tmp_path: Path):
    folder = tmp_path / "d"
    folder.mkdir()
    for name in ("follower", "recording.json"):
        (folder / name).write_text("years of work")
    (folder / "leader.json").write_text("[1, 2]")
    before = files(folder)
    free = {"output_dir": tmp_path / "out", which: folder}
    words = [f"--{name}={path}" for name, path in free.items()]
    assert main(["serve", "--task.type=lift", "--leader=none", *words, "--", "true"]) == 2
    assert files(folder) == before


def told(station: Station, joint: int, degrees: float) -> None:
    """Turn the torque on and tell one joint to go somewhere else, from where it is."""
    bus = station.buses["follower"]
    bus["Torque_Enable"] = 1
    bus["Goal_Position"] = bus["Present_Position"] + np.eye(6)[joint] * degrees / 360 * 4096


def test_a_badly_calibrated_arm_shows_angles_that_its_zeros_correct(tmp_path: Path):
    yaml = tmp_path / "bent.yaml"
    yaml.write_text("extends: so101\nzeros: {elbow_flex: 10}\n")
    station = station_of(tmp_path / "out", robot=str(yaml))
    shown = station.buses["follower"]["Present_Position"] / 4096 * 360 - 180
    off = shown - np.degrees(station.follower.q)
    station.close()
    np.testing.assert_allclose(off, [0, 0, -10, 0, 0, 0], atol=0.1)


@pytest.mark.parametrize(("servo", "most"), [("ideal", 0.6), ("sts3215", 6.0)])
def test_joints_go_where_they_are_told(tmp_path: Path, servo: str, most: float):
    """Ideal servos to within a fraction of a degree; real ones sag and have play."""
    station = station_of(tmp_path, servo=servo)
    before = station.env.world.measured
    told(station, 0, 20.0)
    run(station, 2.0)
    moved = station.env.world.measured - before
    assert moved[0] == pytest.approx(20.0, abs=most)
    assert np.abs(moved[1:5]).max() < most
    station.close()


def test_commands_and_readings_are_late(tmp_path: Path):
    late = 0.3
    station = station_of(tmp_path, servo="ideal", latency=late)
    told(station, 0, 20.0)
    before, read = station.follower.q[0], station.buses["follower"]["Present_Position"][0]
    run(station, late - 0.05)
    assert station.follower.q[0] == pytest.approx(before, abs=1e-3)
    run(station, 0.3)
    assert station.follower.q[0] > before + 0.1
    assert station.buses["follower"]["Present_Position"][0] == pytest.approx(read, abs=2)
    run(station, 1.0)
    assert station.buses["follower"]["Present_Position"][0] > read + 100
    station.close()


def test_of_messages_the_last_that_was_sent_counts_and_some_are_lost():
    link = Link(SessionConfig(latency=0.1, jitter=0.2, drop=0.25), -1, np.random.default_rng(0))
    arrived = []
    for number in range(2000):
        link.send(number * 0.01, number)
        arrived.append(link.receive(number * 0.01))
    assert arrived == sorted(arrived)
    assert arrived[:10] == [-1] * 10
    late = np.arange(2000)[100:] - arrived[100:]
    assert late.min() >= 10
    assert late.max() <= 35
    always = Link(SessionConfig(drop=0.25), -1, np.random.default_rng(0))
    kept = set()
    for number in range(2000):
        always.send(number, number)
        kept.add(always.receive(number))
    assert len(kept) == pytest.approx(1500, abs=100)


def test_an_arm_whose_torque_is_off_stays(station: Station):
    before = station.env.world.measured
    run(station, 1.0)
    assert np.abs(station.env.world.measured - before)[:5].max() < 2.0


def test_a_lower_gain_sags_more(station: Station):
    told(station, 0, 0.0)
    sags = list[float]()
    for gain in (32, 16):
        station.buses["follower"]["P_Coefficient"] = gain
        run(station, 1.0)
        sags.append(np.abs(station.follower.q - station.follower.goal())[:5].max())
    assert sags[1] > 1.3 * sags[0]


def test_the_expert_at_the_leader_solves_the_task_through_the_servos(station: Station):
    station.mover = station.expert
    station.buses["follower"]["Torque_Enable"] = 1

    def follow() -> bool:
        station.buses["follower"]["Goal_Position"] = station.buses["leader"]["Present_Position"]
        return not station.is_solved and station.env.get_state().step < 400

    station.clock.wait = lambda: None
    station.run(follow)
    assert station.is_solved


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Iterator[Path]:
    """The folder of a session in a process of its own, as a user has it."""
    folder = tmp_path_factory.mktemp("serve")
    words = ["serve", "--task.type=lift", "--servo=ideal", f"--output_dir={folder}"]
    with subprocess.Popen(
        [sys.executable, "-m", "manip_il.cli.main", *words], stdout=subprocess.PIPE, text=True
    ) as run:
        assert run.stdout is not None
        assert "lerobot-record" in "".join(run.stdout.readline() for _ in range(4))
        yield folder
        run.send_signal(signal.SIGTERM)
        assert run.wait(30) == 0
        assert not (folder / "follower").is_symlink()


@pytest.mark.slow
def test_lerobots_own_drivers_open_it(served: Path):
    """Their calibration fits, a target moves the arm, and a leader with torque is moved by what
    it is told.
    """
    follower = SO101Follower(
        SOFollowerRobotConfig(port=str(served / "follower"), id="follower", calibration_dir=served)
    )
    leader = SO101Leader(
        SOLeaderTeleopConfig(port=str(served / "leader"), id="leader", calibration_dir=served)
    )
    follower.connect(calibrate=False)
    leader.connect(calibrate=False)
    assert follower.is_calibrated
    assert leader.is_calibrated
    seen = follower.get_observation()
    target = {**seen, "shoulder_pan.pos": seen["shoulder_pan.pos"] + 15}
    for _ in range(40):
        follower.send_action(target)
        time.sleep(1 / 30)
    assert follower.get_observation()["shoulder_pan.pos"] == pytest.approx(
        target["shoulder_pan.pos"], abs=1
    )
    leader.enable_torque()
    leader.send_feedback({**leader.get_action(), "wrist_flex.pos": 40.0})
    time.sleep(2.0)
    assert leader.get_action()["wrist_flex.pos"] == pytest.approx(40.0, abs=0.5)
    follower.disconnect()
    leader.disconnect()


@pytest.mark.slow
def test_a_program_that_is_killed_can_be_started_again(served: Path):
    """It dies between a write and its answer; the next one finds all servos."""
    words = [sys.executable, "-c", _READER, str(served / "follower")]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == b"reads\n"
        reader.kill()
    time.sleep(0.5)
    follower = SO101Follower(
        SOFollowerRobotConfig(port=str(served / "follower"), id="follower", calibration_dir=served)
    )
    follower.connect(calibrate=False)
    assert len(follower.get_observation()) == 6
    follower.disconnect()


_READER = """
import sys
from lerobot.motors import Motor, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus
bus = FeetechMotorsBus(sys.argv[1], {"a": Motor(1, "sts3215", MotorNormMode.DEGREES)})
bus.connect()
print("reads", flush=True)
while True:
    bus.sync_read("Present_Position", normalize=False)
"""
