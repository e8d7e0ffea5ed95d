"""The expert is a function of the state: continuous within a rung, never a jump, silent where it
knows nothing.
"""

from dataclasses import replace
from functools import cache, lru_cache

import numpy as np
import pytest

from manip_il import Expert
from manip_il.collect.drivers import driver_of
from manip_il.collect.job import RolloutJob, run_steps
from manip_il.mdp import Label, State
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.scene import SCENES_KEPT
from manip_il.sim.world import GOAL, Scene, World
from manip_il.tasks.objects import UPRIGHT
from manip_il.tasks.table import get_task
from manip_il.worlds.ladder.world import scene_of
from manip_il.worlds.table import make_config, make_env

from ..scenes import sizes_of, started
from ..tables import every_robot, every_scene, every_scene_with_a_cube

DRIVERS = ("random", "varied")  # the latter is the expert with cubes of many sizes
STEEPEST = 50.0  # change of a joint target per change of the object's position [rad/m]


@lru_cache(SCENES_KEPT)
def expert_of(robot: str, task: str) -> Expert:
    return Expert(scene_of(robot, task))


@cache
def visited_states(robot: str, task: str, driver: str) -> tuple[State, ...]:
    """States of two episodes that a driver visited."""
    config = make_config(robot, task, horizon=40)
    conditions = tuple(sizes_of(task)) if driver == "varied" else ()
    episodes = RolloutJob(config, driver_of(driver), hold=3, conditions=conditions).run(
        stream_seeds("certificate", 2)
    )
    return tuple(
        State.from_vector(row) for episode in episodes for row in episode.columns["sim_state"]
    )


def written(label: Label) -> bytes:
    return (
        label.action.tobytes()
        + np.float64(label.residual).tobytes()
        + bytes([label.phase, label.valid])
    )


world_of = lru_cache(SCENES_KEPT)(World)


def world_in(scene: Scene, state: State) -> World:
    world = world_of(scene)
    world.restore(state.physics, state.variation)
    return world


def joints(scene: Scene, state: State) -> np.ndarray:
    return world_in(scene, state).data.qpos[scene.arm_q]


def with_object(scene: Scene, state: State, move: np.ndarray) -> State:
    """The state with its object moved by `move` [m]."""
    world, one = world_in(scene, state), scene.objects[scene.task.grasped[0]]
    world.data.qpos[one.q : one.q + 3] += move
    return replace(state, physics=world.physics())


KNOCKED = Condition("knocked", knock=(0.05, 0.08), knock_step=(5, 9), joint_noise=(0.01, 0.02))


@pytest.mark.parametrize("driver", DRIVERS)
@every_scene
def test_a_label_read_off_a_running_world_is_that_of_its_state(robot: str, task: str, driver: str):
    """Also where it was knocked, has other sizes, and is observed with noise."""
    knocked = KNOCKED.for_world(has_object=bool(get_task(task).objects), sees=False, sizes=None)
    conditions = (*(sizes_of(task) if driver == "varied" else ()), *([knocked] if knocked else ()))
    config, expert = make_config(robot, task, horizon=30), expert_of(robot, task)
    job = RolloutJob(config, driver_of(driver), hold=3, conditions=conditions)
    for step in run_steps(
        job, [make_env(config, None, conditions)], stream_seeds("certificate", 2)
    ):
        assert step.label is not None
        assert written(step.label) == written(expert.label(step.state))


@pytest.mark.parametrize("driver", DRIVERS)
@every_scene
def test_a_label_is_a_step_that_the_arm_can_make(robot: str, task: str, driver: str):
    expert, scene = expert_of(robot, task), scene_of(robot, task)
    actions = scene.actions
    for state in visited_states(robot, task, driver):
        label = expert.label(state)
        (low, _), (high, _), (wanted, _) = (
            actions.split(one) for one in (actions.low, actions.high, label.action)
        )
        q = np.clip(joints(scene, state), low, high)
        assert np.abs(wanted - q).max() <= scene.robot.max_joint_step + 1e-9
        assert (actions.low <= label.action).all()
        assert (label.action <= actions.high).all()
        assert label.residual >= 0
        assert label.valid == (label.phase != 0) == (label.reason == "")


@pytest.mark.parametrize("driver", DRIVERS)
@every_scene_with_a_cube
def test_within_a_rung_the_label_follows_the_object_continuously(
    robot: str, task: str, driver: str
):
    expert, scene, rng = expert_of(robot, task), scene_of(robot, task), np.random.default_rng(0)
    compared, size = 0, 1e-5
    states = visited_states(robot, task, driver)
    for state in states:
        move = rng.normal(size=3)
        label, near = (
            expert.label(state),
            expert.label(with_object(scene, state, move * size / np.linalg.norm(move))),
        )
        if label.phase == near.phase:
            compared += 1
            (there, _), (here, _) = (scene.actions.split(one.action) for one in (near, label))
            assert np.abs(there - here).max() <= STEEPEST * size
    assert compared > 0.9 * len(states)


@pytest.mark.parametrize(
    ("move", "reason"),
    [((1.0, 0, 0), "object out of reach"), ((0, 0, -0.3), "object off the table")],
)
@every_scene_with_a_cube
def test_where_there_is_no_sound_label_the_arm_holds_still(
    robot: str, task: str, move, reason: str
):
    expert, scene = expert_of(robot, task), scene_of(robot, task)
    state = with_object(scene, visited_states(robot, task, "expert")[3], np.array(move, float))
    label = expert.label(state)
    assert (label.valid, label.phase, label.reason) == (False, 0, reason)
    held = scene.actions.join(joints(scene, state), world_in(scene, state).opening)
    np.testing.assert_array_equal(label.action, held)


@every_robot
def test_a_goal_that_the_arm_cannot_get_nearer_to_is_no_label(robot: str):
    env = started(robot, "reach")
    expert = Expert(env.scene)
    reasons = set[str]()
    for _ in range(100):
        env.world.place(GOAL, np.array([3.0, 0.0, 0.3]), UPRIGHT)
        label = expert.label(env.get_state())
        reasons.add(label.reason)
        env.advance(label.action)
    assert reasons == {"", "no joint step brings the hand nearer"}
