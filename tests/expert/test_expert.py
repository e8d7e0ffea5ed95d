"""The expert is a function of the state: continuous within a rung, never a jump, silent where it knows nothing."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from manip_il.errors import MismatchError
from manip_il.expert.expert import Expert
from manip_il.mdp import Label, Phase, State
from manip_il.sim.env import ManipEnv
from manip_il.sim.scene import Scene, build_scene

ROBOTS, TASKS = ("panda", "fetch"), ("reach", "lift", "pick_place")
DRIVERS = ("expert", "random")
STEEPEST = 50.0  # change of a joint target per change of the object's position [rad/m]


@cache
def expert_of(robot: str, task: str = "pick_place") -> Expert:
    return Expert(build_scene(robot, task))


def written(label: Label) -> bytes:
    return label.action.tobytes() + np.float64(label.residual).tobytes() + bytes([label.phase, label.valid])


def joints(scene: Scene, state: State) -> np.ndarray:
    return state.physics[scene.qpos_slice][scene.arm_q]


def with_object(scene: Scene, state: State, move: np.ndarray) -> State:
    """The state with its object moved by `move` [m]."""
    physics = state.physics.copy()
    start = scene.qpos_slice.start + scene.object_q
    physics[start : start + 3] += move
    return replace(state, physics=physics)


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_labels_do_not_depend_on_what_was_asked_before(robot: str, driver: str, visited_states):
    states = visited_states(robot, "pick_place", driver)
    expert = expert_of(robot)
    forward = [written(expert.label(state)) for state in states]
    order = np.random.default_rng(0).permutation(len(states))
    shuffled = {int(i): written(expert.label(states[i])) for i in order}
    assert [shuffled[i] for i in range(len(states))] == forward
    for i in (3, len(states) // 2):
        assert written(Expert(build_scene(robot, "pick_place")).label(states[i])) == forward[i]


def test_asking_changes_neither_state_nor_answer(visited_states):
    expert, state = expert_of("panda"), visited_states("panda", "pick_place", "expert")[5]
    before = state.to_vector().tobytes()
    first = expert.label(state)
    copy = first.action.copy()
    expert.label(visited_states("panda", "pick_place", "expert")[9])
    assert state.to_vector().tobytes() == before
    np.testing.assert_array_equal(first.action, copy)


def test_labels_do_not_depend_on_clock_or_count(visited_states):
    expert, state = expert_of("fetch"), visited_states("fetch", "pick_place", "expert")[8]
    later = replace(state, step=77, streak=3, ever=True)
    assert written(expert.label(later)) == written(expert.label(state))


IN_ANOTHER_PROCESS = """
import sys
import numpy as np
from manip_il.expert.expert import Expert
from manip_il.mdp import State
from manip_il.sim.scene import build_scene
for robot in ("panda", "fetch"):
    expert = Expert(build_scene(robot, "pick_place"))
    labels = [expert.label(State.from_vector(row)) for row in np.load(f"{sys.argv[1]}/{robot}_states.npy")]
    answers = [[*label.action, label.residual, label.phase, label.valid] for label in labels]
    np.save(f"{sys.argv[1]}/{robot}_labels.npy", answers)
"""


@pytest.mark.slow
def test_another_process_answers_the_same_bits(visited_states, tmp_path):
    here: dict[str, np.ndarray] = {}
    for robot in ROBOTS:
        expert = expert_of(robot)
        states = visited_states(robot, "pick_place", "expert") + visited_states(robot, "pick_place", "random")
        labels = [expert.label(state) for state in states]
        here[robot] = np.array([[*label.action, label.residual, label.phase, label.valid] for label in labels])
        np.save(tmp_path / f"{robot}_states.npy", [state.to_vector() for state in states])
    subprocess.run([sys.executable, "-c", IN_ANOTHER_PROCESS, tmp_path], check=True)
    for robot in ROBOTS:
        assert np.load(tmp_path / f"{robot}_labels.npy").tobytes() == here[robot].tobytes()


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_label_is_a_step_that_the_arm_can_make(robot: str, task: str, driver: str, visited_states):
    expert, scene = expert_of(robot, task), build_scene(robot, task)
    low, high = scene.arm_range.T
    for state in visited_states(robot, task, driver):
        label = expert.label(state)
        q = np.clip(joints(scene, state), low, high)
        assert np.abs(label.action[:-1] - q).max() <= scene.robot.max_joint_step + 1e-9
        assert (low <= label.action[:-1]).all()
        assert (label.action[:-1] <= high).all()
        assert label.residual >= 0
        assert label.valid == (label.phase != Phase.NONE) == (label.reason == "")


@pytest.mark.parametrize("robot", ROBOTS)
def test_an_arm_outside_its_limits_is_led_back(robot: str, visited_states):
    expert, scene = expert_of(robot), build_scene(robot, "pick_place")
    state = visited_states(robot, "pick_place", "expert")[0]
    limited = int(np.flatnonzero(np.isfinite(scene.arm_range[:, 1]))[0])
    physics = state.physics.copy()
    physics[scene.qpos_slice.start + scene.arm_q[limited]] = scene.arm_range[limited, 1] + 0.02
    action = expert.label(replace(state, physics=physics)).action
    assert action[limited] <= scene.arm_range[limited, 1]


@pytest.mark.parametrize("size", [1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_within_a_rung_the_label_follows_the_object_continuously(robot: str, driver: str, size: float, visited_states):
    expert, scene, rng = expert_of(robot), build_scene(robot, "pick_place"), np.random.default_rng(0)
    compared = 0
    states = visited_states(robot, "pick_place", driver)
    for state in states:
        move = rng.normal(size=3)
        label, near = expert.label(state), expert.label(with_object(scene, state, move * size / np.linalg.norm(move)))
        if label.phase == near.phase:
            compared += 1
            assert np.abs(near.action[:-1] - label.action[:-1]).max() <= STEEPEST * size
    assert compared > 0.9 * len(states)


@pytest.mark.parametrize(
    ("move", "reason"), [((1.0, 0, 0), "object out of reach"), ((0, 0, -0.3), "object off the table")]
)
@pytest.mark.parametrize("robot", ROBOTS)
def test_where_there_is_no_sound_label_the_arm_holds_still(robot: str, move, reason: str, visited_states):
    expert, scene = expert_of(robot), build_scene(robot, "pick_place")
    state = with_object(scene, visited_states(robot, "pick_place", "expert")[3], np.array(move, float))
    label = expert.label(state)
    assert (label.valid, label.phase, label.reason) == (False, Phase.NONE, reason)
    np.testing.assert_array_equal(label.action[:-1], joints(scene, state))
    assert label.action[-1] == state.physics[scene.qpos_slice][scene.finger_q].sum()


def test_without_a_solution_the_arm_holds_still_and_says_so(monkeypatch, visited_states):
    scene = build_scene("panda", "pick_place")
    expert, state = Expert(scene), visited_states("panda", "pick_place", "expert")[3]
    monkeypatch.setattr(expert._ik, "step", lambda *_: None)
    label = expert.label(state)
    assert (label.valid, label.reason) == (False, "inverse kinematics has no solution")
    np.testing.assert_array_equal(label.action[:-1], joints(scene, state))


def test_a_goal_that_the_arm_cannot_get_nearer_to_is_no_label():
    env = ManipEnv("panda", "reach")
    env.start(5_000_000)
    expert = Expert(env.scene)
    reasons = set[str]()
    for _ in range(100):
        label = expert.label(replace(env.get_state(), goal=np.array([3.0, 0.0, 0.3])))
        reasons.add(label.reason)
        env.advance(label.action)
    assert reasons == {"", "no joint step brings the hand nearer"}


def test_a_state_of_another_scene_is_refused_with_both_sizes(visited_states):
    state = visited_states("panda", "reach", "expert")[0]
    with pytest.raises(MismatchError) as caught:
        expert_of("panda", "lift").label(state)
    assert str(len(state.physics)) in str(caught.value)
    assert str(build_scene("panda", "lift").state_size) in str(caught.value)
