"""An action is joint targets and one opening, by name and within bounds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from manip_il.robots.action_space import ActionSpace
from manip_il.worlds.ladder.world import scene_of

from ..tables import every_robot

finite = st.floats(-1e6, 1e6)

SPACE = ActionSpace(
    names=("pan", "lift", "free", "gripper"),
    low=np.array([-1.0, -2.0, -np.inf, 0.0]),
    high=np.array([1.0, 0.5, np.inf, 0.08]),
    scale=np.array([0.1, 0.1, 0.1, 0.08]),
    relative=np.array([True, True, True, False]),
)


@given(arrays(np.float64, 3, elements=finite), finite)
def test_what_was_joined_comes_apart_again(arm: np.ndarray, opening: float):
    action = SPACE.join(arm, opening)
    np.testing.assert_array_equal(action[SPACE.arm], arm)
    assert action[SPACE.gripper] == opening


@given(arrays(np.float64, 4, elements=finite))
def test_a_clipped_action_is_the_nearest_within_the_bounds(action: np.ndarray):
    clipped = SPACE.clip(action, 0)
    assert (clipped >= SPACE.low).all()
    assert (clipped <= SPACE.high).all()
    inside = (action >= SPACE.low) & (action <= SPACE.high)
    np.testing.assert_array_equal(clipped[inside], action[inside])
    np.testing.assert_array_equal(SPACE.clip(clipped, 0), clipped)
    assert clipped[2] == action[2]  # it turns freely


@every_robot
def test_a_scenes_actions_are_its_robots_joints_in_their_ranges(robot: str):
    scene = scene_of(robot, "reach")
    actions, gripper = scene.actions, scene.gripper
    assert actions.names == scene.robot.joint_names
    assert (actions.low < actions.high).all()
    np.testing.assert_allclose(
        [actions.split(end)[1] for end in (actions.low, actions.high)],
        [gripper.least, gripper.most],
    )
    home = actions.join(np.asarray(scene.robot.home), gripper.most)
    np.testing.assert_array_equal(actions.clip(home, 0), home)
    in_degrees = actions.units is not None
    step = np.degrees(scene.robot.max_joint_step) if in_degrees else scene.robot.max_joint_step
    assert (actions.scale[actions.arm] == step).all()
    assert actions.scale[actions.gripper] == np.ptp(
        [actions.low[actions.gripper], actions.high[actions.gripper]]
    )
