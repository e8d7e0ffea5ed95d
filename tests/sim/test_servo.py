"""An arm with servos: late, limited in speed, and whole in its state."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from manip_il.cli.main import main
from manip_il.errors import ManipError
from manip_il.mdp import F64, State
from manip_il.robots import NAMED_SERVOS
from manip_il.robots.servos import PARAMETERS, default_servo, servo_ranges, servos_of
from manip_il.robots.table import get_robot
from manip_il.sim.conditions import Condition
from manip_il.worlds.ladder.expert import LadderExpert
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import make_config

SO101 = get_robot("so101")
PAN = 0  # the joint about the vertical, on which gravity does not act


def env_of(**servo: float) -> LadderEnv:
    """Return the environment of an SO-101 with such servos, which vary."""
    own = {name: (value,) * 3 for name, value in servo.items()}
    usual = servos_of("sts3215", SO101.joint_names)
    robot = replace(SO101, servos={joint: {**one, **own} for joint, one in usual.items()})
    varied = [Condition("servo", servo=1)] if not servo else []
    return LadderEnv(make_config("so101", "lift"), None, varied, robot)


def step_of(env: LadderEnv, angle: float, seconds: float = 1.5) -> F64:
    """Return how far the pan joint goes, after it is told to go by an angle, (T,) [rad]."""
    env.start(0)
    start = env.world.measured
    goal = start + np.degrees(angle) * (np.arange(len(start)) == PAN)
    seen: list[float] = []
    for _ in range(round(seconds * env.config.control_hz)):
        env.advance(goal)
        seen.append(np.radians(env.world.measured[PAN] - start[PAN]))
    return np.array(seen)


def test_nothing_moves_before_the_delay_has_passed():
    moved = step_of(env_of(delay=0.2), 0.5)
    assert np.abs(moved[:6]).max() < 1e-3
    assert moved[-1] == pytest.approx(0.5, abs=0.03)


def test_the_goal_moves_no_faster_than_its_speed():
    slow, fast = (np.diff(step_of(env_of(speed=speed), 1.0)).max() * 30 for speed in (1.0, 20.0))
    assert slow < 1.3
    assert fast > 2.5


def test_a_joint_at_rest_is_within_friction_and_play_of_its_goal():
    servo = dict(zip(PARAMETERS, default_servo(), strict=True))
    most = servo["friction"] / (servo["stiffness"] / 2) + np.radians(servo["play"]) / 2
    assert abs(step_of(env_of(stiffness=servo["stiffness"]), 0.5)[-1] - 0.5) <= most + 1e-3
    assert step_of(env_of(friction=0.0, play=0.0), 0.5)[-1] == pytest.approx(0.5, 1e-3)


@pytest.fixture(scope="module")
def driven():
    """An environment whose servos vary, and its expert, who drove for ten steps."""
    env = env_of()
    env.start(3)
    expert = LadderExpert(env.scene)
    for _ in range(10):
        env.advance(expert.label(env.get_state(), env).action)
    return env, expert


def test_a_restored_state_has_its_servos_and_goes_on_the_same(driven):
    env, expert = driven
    state = State.from_vector(env.get_state().to_vector())
    other = env_of()
    other.start(5)
    other.advance(other.world.measured)
    other.set_state(state)
    action = expert.label(state, env).action
    assert np.array_equal(LadderExpert(other.scene).label(state).action, action)
    for one in (env, other):
        one.set_state(state)
        for _ in range(5):
            one.advance(action)
    assert np.array_equal(env.get_state().physics, other.get_state().physics)


def test_servos_that_vary_differ_within_their_ranges(driven):
    env, _ = driven
    servos = env.scene.servos
    values, low, high = servos.ranges
    drawn = np.array([servos.of(env.data, name) for name in PARAMETERS]).T
    assert ((low <= drawn) & (drawn <= high)).all()
    assert (drawn != values).all()


def test_the_expert_solves_the_task_through_the_servos(driven):
    env, expert = driven
    env.start(1)
    for _ in range(env.config.horizon):
        label = expert.label(env.get_state(), env)
        if not env.solved:
            env.advance(label.action)
    assert env.solved


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"extends": "panda2"}, "panda2"),
        ({"extends": "arm.yaml"}, "extends itself"),
        ({"hand": "gripper", "model": "x.xml"}, "model"),
        ({"servos": {"shoulder_pan": {}}}, "servos has shoulder_pan; expected"),
        ({"servos": {"shoulder_pan": 3}}, "servos"),
        ({"servos": "mg996"}, "sts3215"),
    ],
)
def test_a_wrong_yaml_is_one_line(
    change: dict, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "arm.yaml"
    path.write_text(
        "\n".join(f"{key}: {one}" for key, one in ({"extends": "so101"} | change).items())
    )
    assert main(["eval", "--policy.type=expert", f"--robot.type={path}", "--task.type=lift"]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert said in line


@pytest.mark.parametrize("name", NAMED_SERVOS)
def test_named_servos_are_within_the_bounds_and_their_ranges(name: str):
    values, low, high = servo_ranges(servos_of(name, ["pan.pos"]), ["pan.pos"])
    assert ((low <= values) & (values <= high)).all()


def test_values_out_of_bounds_are_named():
    [servo] = servos_of("sts3215", ["pan"]).values()
    with pytest.raises(ManipError, match=r"servos.pan.delay"):
        servo_ranges({"pan": {**servo, "delay": (3.0, 0.0, 0.0)}}, ["pan.pos"])
    with pytest.raises(ManipError, match=r"servos.pan.delay .* expected \[value, low, high\]"):
        servo_ranges({"pan": {**servo, "delay": (0.1, 0.2, 0.3)}}, ["pan.pos"])
