"""Inverse kinematics solves the quadratic program that mink builds of its tasks and limits, bit
for bit.
"""

from typing import Any

import daqp
import mink
import numpy as np
import pytest

from manip_il.robots import ik
from manip_il.robots.geometry import hand_down
from manip_il.robots.ik import ArmIK
from manip_il.robots.robot import Robot
from manip_il.robots.spec import arm_model
from manip_il.robots.table import get_robot

from ..tables import every_robot


def problem_of_mink(
    robot: Robot, q: np.ndarray, position: np.ndarray, rotation: np.ndarray
) -> list[np.ndarray]:
    """Matrices and vectors of the program as mink's own tasks and limits make it."""
    model = arm_model(robot)
    configuration, home = mink.Configuration(model), np.zeros(model.nq)
    address = [model.joint(name).qposadr[0] for name in robot.joints]
    home[address] = robot.home
    frame = mink.FrameTask("ee", "site", 1.0, robot.costs.orientation, lm_damping=ik._LM_DAMPING)
    turned = mink.SO3.from_matrix(rotation)
    frame.set_target(mink.SE3.from_rotation_and_translation(turned, position))
    posture = mink.PostureTask(model, cost=robot.costs.posture)
    posture.set_target(home)
    there = np.zeros(model.nq)
    there[address] = q
    configuration.update(there)
    limits = [mink.ConfigurationLimit(model)]
    problem = mink.build_ik(configuration, [frame, posture], 1.0, ik._DAMPING, limits)
    return [np.asarray(one) for one in (problem.P, problem.q, problem.G, problem.h)]


@every_robot
def test_the_program_is_minks(robot: str, monkeypatch: pytest.MonkeyPatch):
    solved: list[Any] = []
    plain = daqp.solve
    monkeypatch.setattr(
        ik.daqp, "solve", lambda *problem: solved.append(problem) or plain(*problem)
    )
    the_robot, rng = get_robot(robot), np.random.default_rng(0)
    arm, home = ArmIK(the_robot), np.asarray(the_robot.home)
    for _ in range(20):
        q = home + rng.uniform(-0.3, 0.3, len(home))
        position = np.array([*the_robot.workspace.centre, 0.1]) + rng.uniform(-0.1, 0.1, 3)
        rotation = hand_down(rng.uniform(-1, 1))
        arm.ee_pose(q)
        assert arm.displacement(position, rotation, 0.1) is not None
        for ours, theirs in zip(
            solved[-1], problem_of_mink(the_robot, q, position, rotation), strict=False
        ):
            np.testing.assert_array_equal(ours, theirs)


def moves(robot: Robot, largest: float, rows: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Joints (rows, arm) around home, and motions of the hand (rows, 6) up to so many [m] and,
    tripled, [rad].
    """
    arm, rng = ArmIK(robot), np.random.default_rng(1)
    q = np.asarray(robot.home) + rng.uniform(-0.5, 0.5, (rows, len(robot.home)))
    motions = rng.uniform(-largest, largest, (rows, 6)) * np.repeat([1.0, 3.0], 3)
    return np.clip(q, arm.limits[:, 0], arm.limits[:, 1]), motions


@every_robot
def test_a_motion_does_not_depend_on_its_batch(robot: str):
    arm = ArmIK(get_robot(robot))
    q, motions = moves(get_robot(robot), 0.1)
    together = arm.moved(q, motions)
    for size in (1, 3, 16):
        parts = [arm.moved(q[i : i + size], motions[i : i + size]) for i in range(0, len(q), size)]
        np.testing.assert_array_equal(np.concatenate(parts), together)
    np.testing.assert_array_equal(arm.moved(q[::-1], motions[::-1]), together[::-1])
