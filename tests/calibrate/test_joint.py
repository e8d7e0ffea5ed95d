"""One joint as equations: late, limited in speed, true to the arm that `serve` simulates."""

from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
import pytest

from manip_il.calibrate.joint import simulate
from manip_il.mdp import F64
from manip_il.serve.config import ServoConfig, SessionConfig
from manip_il.serve.station import Station
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import make_config

DT = 1 / 480  # [s]
SECONDS = 1.5
PAN = 0  # the joint about the vertical, on which gravity does not act


def moved(goals: F64, start: float = 0.0, inertia: float = 0.01, **servo: float) -> F64:
    """Return the positions of a joint without load at P_Coefficient 16, (T,) [rad]."""
    return simulate(
        {name: np.array(value) for name, value in asdict(ServoConfig(**servo)).items()},
        goals[None],
        np.array([start]),
        DT,
        gain=np.array(16),
        inertia=np.array([inertia]),
        load=lambda sample, x: 0 * x,
    )[0]


def step_of(angle: float) -> F64:
    """Return goals that jump from 0 to an angle after the first sample, (T,) [rad]."""
    return np.r_[0.0, np.full(round(SECONDS / DT), angle)]


def test_nothing_moves_before_the_delay_has_passed():
    positions = moved(step_of(0.5), delay=0.1)
    late = round(0.1 / DT)
    assert np.abs(positions[:late]).max() == 0
    assert positions[-1] == pytest.approx(0.5, abs=0.03)


def test_the_goal_moves_no_faster_than_its_speed():
    slow, fast = (moved(step_of(1.0), play=0.0, friction=0.0, speed=s) for s in (1.0, 20.0))
    assert np.diff(slow).max() / DT < 1.3
    assert np.diff(fast).max() / DT > 2.5


def test_a_joint_at_rest_is_within_friction_and_play_of_its_goal():
    servo = ServoConfig()
    most = servo.friction / (servo.stiffness / 2) + np.radians(servo.play) / 2
    assert abs(moved(step_of(0.5))[-1] - 0.5) <= most + 1e-3
    assert moved(step_of(0.5), friction=0.0, play=0.0)[-1] == pytest.approx(0.5, abs=1e-3)


def test_it_moves_as_the_arm_that_is_served(tmp_path: Path):
    station = Station(LadderEnv(make_config("so101", "lift")), SessionConfig(output_dir=tmp_path))
    station.reset(1)
    env, bus = station.env, station.buses["follower"]
    full = np.zeros((env.world.model.nv,) * 2)
    mujoco.mj_fullM(env.world.model, env.data, full)
    dof = station.follower._dof[PAN]
    inertia = full[dof, dof] - env.world.model.dof_armature[dof]
    start, goal = env.data.qpos[station.follower.q[PAN]], 0.4
    bus["Torque_Enable"] = 1
    bus["P_Coefficient"] = 16
    goals = bus["Goal_Position"]
    goals[PAN] += round(goal / (2 * np.pi) * 4096)
    bus["Goal_Position"] = goals
    seen = [start]
    station.clock.wait = lambda: None

    def each_step() -> bool:
        seen.append(env.data.qpos[station.follower.q[PAN]])
        return len(seen) < 45

    station.run(each_step)
    station.close()
    every = env.config.physics_steps
    goals = np.r_[start, np.full(45 * every, start + goal)]
    expected = moved(goals, start, inertia)[::every]
    assert np.abs(np.array(seen[1:]) - expected[: len(seen) - 1]).max() < 0.03
