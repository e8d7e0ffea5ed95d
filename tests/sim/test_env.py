"""The environment is gymnasium's, and a function of its state and the actions."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from manip_il.errors import MismatchError, NotFiniteError, UsageError
from manip_il.sim.conditions import Condition
from manip_il.sim.env import EnvConfig, ManipEnv, environment_state_names
from manip_il.sim.register import ENV_IDS, register_envs
from manip_il.sim.world import GOAL
from manip_il.tasks.starts import UPRIGHT

from ..tables import SCENES, every_robot, every_scene, every_scene_with_an_object

SEED = 5_000_000
OTHERS = Condition("others", size=(0.03, 0.07), mass=(0.05, 0.3), friction=(0.6, 0.9))


def still(env: ManipEnv) -> np.ndarray:
    """The action that holds the arm where it is commanded to be."""
    return env.scene.actions.join(env.data.ctrl[env.scene.arm_ctrl], env.world.opening)


def move_goal(env: ManipEnv, at: np.ndarray) -> None:
    env.world.place(GOAL, at, UPRIGHT)
    env.world.update()


def random_actions(env: ManipEnv, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return still(env) + rng.uniform(-0.1, 0.1, (count, len(still(env))))


def trajectory(env: ManipEnv, actions: np.ndarray) -> list[bytes]:
    """What the states and observations are made of, byte for byte, after every action."""
    seen = []
    for action in actions:
        env.advance(action)
        observation = env.observe()
        parts = (env.get_state().to_vector(), observation.state, observation.environment_state)
        seen.append(b"".join(part.tobytes() for part in parts))
    return seen


@every_scene
@pytest.mark.filterwarnings("ignore:.*infinity.*:UserWarning")  # an observation has no bounds
def test_gymnasium_takes_it_for_its_own(robot: str, task: str):
    check_env(ManipEnv(robot, task), skip_render_check=True)


def test_every_robot_and_task_has_a_name_in_gymnasium():
    register_envs()
    register_envs()
    assert {"manip_il/PandaPickPlace-v0", "manip_il/FetchReach-v0"} <= set(ENV_IDS)
    assert sorted(ENV_IDS.values()) == sorted(SCENES)
    for env_id, (robot, task) in ENV_IDS.items():
        env = gymnasium.make(env_id, horizon=6)
        config = env.unwrapped.config  # pyright: ignore[reportAttributeAccessIssue]
        assert (config.robot, config.task, config.horizon) == (robot, task, 6)
        assert env.reset(seed=1)[0]["agent_pos"].dtype == np.float32


@every_scene
def test_a_seed_is_a_start_whatever_ran_before(robot: str, task: str):
    fresh, used = ManipEnv(robot, task), ManipEnv(robot, task)
    used.start(SEED + 1)
    trajectory(used, random_actions(used, 10))
    fresh.start(SEED)
    used.start(SEED)
    actions = random_actions(fresh, 10)
    assert fresh.get_state().to_vector().tobytes() == used.get_state().to_vector().tobytes()
    assert trajectory(fresh, actions) == trajectory(used, actions)


def test_another_seed_is_another_start():
    env = ManipEnv()
    starts = set()
    for seed in range(SEED, SEED + 20):
        env.start(seed)
        starts.add(env.get_state().to_vector().tobytes())
    assert len(starts) == 20


def test_reset_with_a_seed_is_start_with_it():
    one, other = ManipEnv("panda", "lift"), ManipEnv("panda", "lift")
    one.reset(seed=7)
    other.start(7)
    assert one.get_state().to_vector().tobytes() == other.get_state().to_vector().tobytes()
    one.reset()
    assert one.get_state().to_vector().tobytes() != other.get_state().to_vector().tobytes()


@every_scene
@pytest.mark.parametrize("steps", [0, 9, 17])  # before, around and after the grasp
def test_a_restored_state_has_the_same_future(robot: str, task: str, steps: int, drive):
    env, other = ManipEnv(robot, task), ManipEnv(robot, task)
    env.start(SEED)
    drive(env, steps)
    state = env.get_state()
    actions = random_actions(env, 12)
    future = trajectory(env, actions)
    other.start(SEED + 5)
    for where in (env, other):
        where.set_state(state)
        assert where.get_state().to_vector().tobytes() == state.to_vector().tobytes()
        assert trajectory(where, actions) == future


@every_scene_with_an_object
def test_a_restored_state_of_another_cube_has_the_same_future_anywhere(robot: str, task: str, drive):
    env, other, plain = (ManipEnv(robot, task, conditions=one) for one in ((OTHERS,), (OTHERS,), ()))
    env.start(SEED)
    drive(env, 16)
    state = env.get_state()
    actions = random_actions(env, 12)
    future = trajectory(env, actions)
    other.start(SEED + 1)  # with another cube
    plain.start(SEED)
    for where in (env, other, plain):
        where.set_state(state)
        assert where.get_state().to_vector().tobytes() == state.to_vector().tobytes()
        assert trajectory(where, actions) == future


@every_scene
def test_a_restored_state_is_seen_as_it_was(robot: str, task: str, drive):
    env, other = ManipEnv(robot, task), ManipEnv(robot, task)
    env.start(SEED)
    drive(env, 14)
    seen = env.observe()
    other.set_state(env.get_state())
    assert other.observe().state.tobytes() == seen.state.tobytes()
    assert other.observe().environment_state.tobytes() == seen.environment_state.tobytes()
    assert (other.distance(), other.progress) == (env.distance(), env.progress)


def test_asking_for_the_state_or_an_observation_changes_nothing():
    env = ManipEnv()
    env.start(SEED)
    before = env.get_state().to_vector().tobytes()
    env.observe()
    env.distance()
    assert env.get_state().to_vector().tobytes() == before


def test_a_state_of_another_scene_is_refused_with_both_sizes():
    reach, place = ManipEnv("panda", "reach"), ManipEnv("panda", "pick_place")
    reach.start(SEED)
    with pytest.raises(MismatchError) as caught:
        place.set_state(reach.get_state())
    assert str(len(reach.get_state().physics)) in str(caught.value)
    assert str(place.scene.state_size) in str(caught.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_not_finite_is_refused_and_changes_nothing(bad: float):
    env = ManipEnv("panda", "reach")
    env.start(SEED)
    before = env.get_state().to_vector().tobytes()
    action = still(env)
    action[3] = bad
    with pytest.raises(NotFiniteError, match="action at step 0"):
        env.advance(action)
    assert env.get_state().to_vector().tobytes() == before


def test_an_action_of_the_wrong_length_is_refused_with_both_shapes():
    env = ManipEnv("panda", "reach")
    env.start(SEED)
    with pytest.raises(MismatchError, match=r"\(3,\).*\(8,\)"):
        env.advance(np.zeros(3))


@pytest.mark.parametrize("side", [0, 1])
@every_robot
def test_an_action_is_clipped_to_the_joint_limits(robot: str, side: int):
    env = ManipEnv(robot, "reach")
    env.start(SEED)
    actions, gripper, far = env.scene.actions, env.scene.gripper, 100.0 * (2 * side - 1)
    env.advance(np.full(len(actions), far))
    limits = (actions.low, actions.high)[side][actions.arm]
    bounded = np.isfinite(limits)
    assert bounded.any()
    commanded = env.data.ctrl[env.scene.arm_ctrl]
    np.testing.assert_array_equal(commanded[bounded], limits[bounded])
    np.testing.assert_array_equal(commanded[~bounded], far)
    end = (gripper.least, gripper.most)[side]
    np.testing.assert_array_equal(env.data.ctrl[gripper.ctrl], gripper.command(end))


@pytest.mark.parametrize("success_steps", [1, 5])
def test_success_is_so_many_steps_in_a_row(success_steps: int):
    env = ManipEnv("panda", "reach", success_steps=success_steps)
    env.start(SEED)
    here = env.data.site_xpos[env.scene.ee_site].copy()
    move_goal(env, here)
    solved = [env.step(still(env))[4]["is_success"] for _ in range(success_steps + 1)]
    assert solved == [False] * (success_steps - 1) + [True, True]
    move_goal(env, here + [0, 0, 0.1])
    info = env.step(still(env))[4]
    assert (info["is_success"], info["ever_success"]) == (False, True)
    move_goal(env, here)
    assert env.step(still(env))[4]["is_success"] == (success_steps == 1)


@pytest.mark.parametrize(("tolerance", "solved"), [(0.02, False), (0.05, True)])
def test_the_tolerance_decides(tolerance: float, solved: bool):
    env = ManipEnv("panda", "reach", tolerance=tolerance, success_steps=1)
    env.start(SEED)
    move_goal(env, env.data.site_xpos[env.scene.ee_site] + [0, 0, 0.035])
    _, reward, _, _, info = env.step(still(env))
    assert (reward, info["is_success"]) == (float(solved), solved)


def test_an_episode_ends_at_the_horizon_and_by_nothing_else():
    env = ManipEnv("panda", "reach", horizon=7)
    env.reset(seed=SEED)
    ends = [env.step(still(env))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]


def test_a_control_step_lasts_what_its_rate_says():
    env = ManipEnv("panda", "reach", control_hz=25)
    env.start(SEED)
    for _ in range(25):
        env.advance(still(env))
    assert env.data.time == pytest.approx(1.0)
    assert env.metadata["render_fps"] == 25


@every_scene
def test_every_number_that_a_learner_sees_has_a_name(robot: str, task: str):
    env = ManipEnv(robot, task)
    env.start(SEED)
    seen, names = env.observe(), environment_state_names(env.scene)
    assert len(seen.environment_state) == len(names) == len(set(names))
    assert len(seen.state) == len(env.scene.robot.joint_names)
    assert env.observation_space.contains({"agent_pos": seen.state, "environment_state": seen.environment_state})


@pytest.mark.parametrize(
    "setting", [{"control_hz": 0}, {"control_hz": 30}, {"tolerance": 0.0}, {"success_steps": 0}, {"horizon": 4}]
)
def test_a_setting_out_of_range_is_refused(setting: dict):
    with pytest.raises(UsageError, match=str(next(iter(setting.values())))):
        EnvConfig(**setting)
