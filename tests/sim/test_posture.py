"""A posture to begin in: near home, touching nothing, the hand within reach, by the episode's
seed alone.
"""

import numpy as np

from manip_il.sim import events
from manip_il.sim.conditions import Condition
from manip_il.sim.env import ManipEnv
from manip_il.worlds.ladder.world import make_env

from ..scenes import started
from ..tables import every_robot, every_scene

ELSEWHERE = Condition("elsewhere", posture=(0.15, 0.15))
NEAR = 0.03  # of home every episode begins within [rad]


def joints(env: ManipEnv) -> np.ndarray:
    return env.data.qpos[env.scene.arm_q].copy()


@every_scene
def test_the_arm_begins_elsewhere_and_the_task_where_it_would(robot: str, task: str):
    plain, env = started(robot, task), started(robot, task, conditions=[ELSEWHERE])
    offsets = joints(env) - joints(plain)
    assert 0.02 < np.abs(offsets).max() <= 0.15
    np.testing.assert_array_equal(env.data.ctrl[env.scene.arm_ctrl], joints(env))
    np.testing.assert_array_equal(
        np.delete(env.data.qpos, env.scene.arm_q), np.delete(plain.data.qpos, plain.scene.arm_q)
    )
    np.testing.assert_array_equal(env.data.mocap_pos, plain.data.mocap_pos)


@every_robot
def test_the_hand_is_within_reach_and_touches_nothing_at_every_start(robot: str):
    env, offsets = make_env(robot, "clear_table", conditions=[ELSEWHERE]), []
    for seed in range(30):
        env.start(seed)
        assert env.world.reach.has(env.world.ee.position)
        assert not events.arm_contacts(env.world)
        offsets.append(joints(env) - env.scene.robot.home)
    assert np.abs(offsets).max() <= 0.15 + NEAR
    assert (np.std(offsets, axis=0) > 0.06).all()
