"""The environment is gymnasium's, and a function of its state and the actions."""

import itertools

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from manip_il.errors import ManipError, MismatchError, NotFiniteError
from manip_il.robots import ROBOTS
from manip_il.sim.config import DT_SIM
from manip_il.sim.env import ManipEnv
from manip_il.sim.world import GOAL
from manip_il.tasks import ENV_IDS, TASK_IDS, register_envs
from manip_il.tasks.objects import UPRIGHT
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import make_env

from ..scenes import SEED, bits, started, still
from ..tables import SCENES, every_robot, every_scene, every_task


def move_goal(env: ManipEnv, at: np.ndarray) -> None:
    env.world.place(GOAL, at, UPRIGHT)
    env.world.update()


def random_actions(env: ManipEnv, count: int) -> np.ndarray:
    return still(env) + np.random.default_rng(0).uniform(-0.1, 0.1, (count, len(still(env))))


def trajectory(
    env: ManipEnv, actions: np.ndarray
) -> list[tuple[bytes, bytes, bytes, float, float]]:
    """The state, what is observed and how far the task is, as it is and after every action."""
    seen = []
    for step in range(len(actions) + 1):
        shown = env.observe()
        observed = shown.state.tobytes(), shown.environment_state.tobytes()
        seen.append((bits(env), *observed, env.distance(), env.progress))
        if step < len(actions):
            env.advance(actions[step])
    return seen


@every_task
# an observation has no bounds
@pytest.mark.filterwarnings("ignore:.*(infinity|normalized space).*:UserWarning")
def test_gymnasium_takes_it_for_its_own(task: str):
    check_env(make_env("panda", task), skip_render_check=True)


def test_every_robot_and_task_has_a_name_in_gymnasium():
    register_envs()
    register_envs()
    assert {"manip_il/PandaPickPlace-v0", "manip_il/FetchReach-v0"} <= set(ENV_IDS)
    assert sorted(ENV_IDS.values()) == sorted(itertools.product(ROBOTS, TASKS))
    assert set(SCENES) <= set(ENV_IDS.values())
    assert list(TASK_IDS.values()) == list(TASKS)
    for env_id, task in TASK_IDS.items():
        config = gymnasium.make(env_id, robot="fetch").unwrapped.config  # pyright: ignore[reportAttributeAccessIssue]
        assert (config.robot, config.task) == ("fetch", task)
    for env_id, (robot, task) in ENV_IDS.items():
        env = gymnasium.make(env_id, horizon=6, success_steps=1)
        config = env.unwrapped.config  # pyright: ignore[reportAttributeAccessIssue]
        assert (config.robot, config.task, config.horizon) == (robot, task, 6)
        assert env.reset(seed=1)[0]["agent_pos"].dtype == np.float32


@every_scene
def test_a_seed_is_a_start_whatever_ran_before(robot: str, task: str):
    fresh, used = started(robot, task), started(robot, task, SEED + 1)
    trajectory(used, random_actions(used, 10))
    used.start(SEED)
    actions = random_actions(fresh, 10)
    assert trajectory(fresh, actions) == trajectory(used, actions)


def test_another_seed_is_another_start_and_reset_starts_with_its_own():
    env, starts = make_env(), set[bytes]()
    for seed in range(20):
        env.reset(seed=seed)
        starts.add(bits(env))
    assert bits(env) == bits(started(seed=19))
    env.reset()
    assert len(starts | {bits(env)}) == 21


@pytest.mark.parametrize(
    ("wrong", "error", "words"),
    [
        (lambda action: np.append(action[:-1], np.nan), NotFiniteError, "action at step 0"),
        (lambda action: np.append(action[:-1], np.inf), NotFiniteError, "action at step 0"),
        (lambda action: action[:3], MismatchError, r"\(3,\).*\([68],\)"),
    ],
)
@every_robot
def test_an_action_that_is_refused_changes_nothing(
    robot: str, wrong, error: type[ManipError], words: str
):
    env = started(robot, "reach")
    before = bits(env)
    with pytest.raises(error, match=words):
        env.advance(wrong(still(env)))
    assert bits(env) == before


@pytest.mark.parametrize("side", [0, 1])
@every_robot
def test_an_action_is_clipped_to_the_joint_limits(robot: str, side: int):
    env = started(robot, "reach")
    actions, gripper, far = env.scene.actions, env.scene.gripper, 1000.0 * (2 * side - 1)
    env.advance(np.full(len(actions), far))
    limits, _ = actions.split((actions.low, actions.high)[side])
    bounded = np.isfinite(limits)
    assert bounded.any()
    commanded = env.data.ctrl[env.scene.arm_ctrl]
    np.testing.assert_array_equal(commanded[bounded], limits[bounded])
    np.testing.assert_array_equal(commanded[~bounded], far)
    end = (gripper.least, gripper.most)[side]
    np.testing.assert_allclose(env.data.ctrl[gripper.ctrl], gripper.command(end), rtol=1e-12)


@pytest.mark.parametrize("success_steps", [1, 5])
def test_success_is_so_many_steps_in_a_row(success_steps: int):
    env = started("panda", "reach", success_steps=success_steps)
    here = env.data.site_xpos[env.scene.ee_site].copy()
    move_goal(env, here)
    seen = [env.step(still(env))[4] for _ in range(success_steps + 1)]
    solved = [False] * (success_steps - 1) + [True, True]
    assert (
        [info["is_success"] for info in seen] == [info["ever_success"] for info in seen] == solved
    )
    move_goal(env, here + [0, 0, 0.1])
    info = env.step(still(env))[4]
    assert (info["is_success"], info["ever_success"]) == (False, True)
    move_goal(env, here)
    assert env.step(still(env))[4]["is_success"] == (success_steps == 1)


def test_an_episode_ends_at_the_horizon_and_by_nothing_else():
    env = started("panda", "reach", horizon=7)
    ends = [env.step(still(env))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]


@pytest.mark.parametrize("hz", [25, 30])  # of which physics steps of 2 ms divide one
def test_a_control_step_lasts_what_its_rate_says(hz: int):
    env = started("panda", "reach", control_hz=hz)
    for _ in range(hz):
        env.advance(still(env))
    assert env.data.time == pytest.approx(1.0)
    assert env.world.model.opt.timestep <= DT_SIM
    assert env.metadata["render_fps"] == hz
