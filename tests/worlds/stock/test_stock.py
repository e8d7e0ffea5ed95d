"""Stock Fetch environments: as gymnasium makes them, restored bit for bit, and solved by their experts."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from manip_il.tasks.stock.environment import StockEnv
from manip_il.tasks.stock.expert import StockExpert
from manip_il.tasks.stock.table import ACTION_MEANING, CONTROL_HZ, HORIZON, ROBOT, STOCK

from manip_il.collect.drivers import Driver, ExpertDriver, NoisyExpertDriver
from manip_il.collect.job import RolloutJob
from manip_il.errors import MismatchError
from manip_il.evaluation.runner import positions
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import lerobot_options
from manip_il.mdp import State
from manip_il.seeding import stream_seeds
from manip_il.worlds.config import EnvConfig, make_config
from manip_il.worlds.table import env_actions, env_spec

every_stock = pytest.mark.parametrize("task", list(STOCK))


def config(task: str) -> EnvConfig:
    return make_config(ROBOT, task, CONTROL_HZ)


def actions(count: int) -> np.ndarray:
    """Actions that bring the gripper down to the table."""
    drawn = np.random.default_rng(3).uniform(-1, 1, (count, 4))
    drawn[:, 2] -= 0.4
    return drawn


@every_stock
def test_it_is_the_environment_that_gymnasium_makes(task: str):
    module = __import__("gymnasium_robotics")
    gymnasium.register_envs(module)
    theirs, ours = gymnasium.make(task), StockEnv(task)
    seen, _ = theirs.reset(seed=7)
    ours.start(7)
    for action in actions(HORIZON):
        expected = np.append(seen["observation"], seen["desired_goal"]).astype(np.float32)
        assert np.array_equal(ours.observe().environment_state, expected)
        seen, reward, _, over, info = theirs.step(action)
        ours.advance(action)
        assert (ours.reward, ours.solved) == (reward, bool(info["is_success"]))
        assert over == (ours.get_state().step == HORIZON)


@every_stock
def test_a_restored_state_goes_on_bit_for_bit(task: str):
    env, other = StockEnv(task), StockEnv(task)
    env.start(1)
    states, rows = [], []
    for action in actions(30):
        states.append(env.get_state().to_vector())
        rows.append(env.observe().environment_state)
        env.advance(action)
    other.start(2)
    for begin in (0, 13, 29):
        other.set_state(State.from_vector(states[begin]))
        for step in range(begin, 30):
            assert np.array_equal(other.get_state().to_vector(), states[step])
            assert np.array_equal(other.observe().environment_state, rows[step])
            other.advance(actions(30)[step])


def test_a_state_of_another_task_is_refused():
    with pytest.raises(MismatchError, match="size of the state"):
        StockEnv("FetchReach-v4").set_state(StockEnv("FetchPush-v4").get_state())


@every_stock
def test_an_episode_is_50_steps_at_a_cost_of_1_outside_of_5_cm(task: str):
    [episode] = RolloutJob(config(task)).run(stream_seeds("training", 1))
    solved, rewards = episode.columns["next.success"].ravel(), episode.columns["next.reward"].ravel()
    assert len(episode) == HORIZON
    assert np.array_equal(rewards, np.where(solved, 0.0, -1.0))
    assert episode.success_at_end
    spec = env_spec(config(task))
    assert episode.columns["action"].shape[1] == len(spec.joint_names) == len(env_actions(config(task)))
    assert episode.columns["sim_state"].shape[1] == spec.sim_state_size
    assert np.array_equal(episode.columns["action"], episode.columns["executed_action"])


@every_stock
def test_the_expert_is_a_function_of_the_state(task: str):
    env, expert, other = StockEnv(task), StockExpert(task), StockExpert(task)
    env.start(5)
    states = []
    for _ in range(15):
        states.append(env.get_state())
        env.advance(expert.label(states[-1]).action)
    forwards = [expert.label(state).action for state in states]
    backwards = [other.label(state).action for state in reversed(states)][::-1]
    assert np.array_equal(forwards, backwards)
    assert np.abs(forwards).max() <= 1


@every_stock
def test_positions_are_those_of_the_observation(task: str):
    env = StockEnv(task)
    row = dict(zip(STOCK[task].observed, env.observe().environment_state.tolist(), strict=True))
    found = positions(config(task), env.get_state().to_vector())
    names = {"hand": "ee"} | ({"object": "object"} if STOCK[task].has_object else {})
    assert found.keys() == names.keys()
    for name, observed in names.items():
        assert found[name] == pytest.approx([row[f"{observed}.{axis}"] for axis in "xyz"], abs=1e-4)


NOISE = tuple(map(tuple, 0.01 * np.eye(4)))


@pytest.mark.parametrize("driver", [ExpertDriver(), NoisyExpertDriver(NOISE)])
def test_branches_begin_in_the_states_of_the_path(driver: Driver):
    job = RolloutJob(config("FetchReach-v4"), driver, label="branch", branch_steps=3, hold=3)
    [episode] = job.run([1])
    done = np.flatnonzero(episode.columns["next.done"].ravel())
    path = done[0] + 1
    states = episode.columns["sim_state"]
    assert np.array_equal(states[path::3], states[:path])
    assert np.array_equal(np.diff(done), np.full(path, 3))


def test_actions_that_are_no_joint_targets_are_learnt_as_they_are():
    fit = FitConfig(policy={"type": "mlp"})
    assert lerobot_options(fit, ACTION_MEANING)[1] == "joint_target"
    assert lerobot_options(fit)[1] == "joint_delta"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "least", "failures"),
    [("FetchReach-v4", -2, 0), ("FetchPush-v4", -12, 2), ("FetchPickAndPlace-v4", -10, 0)],
)
def test_the_expert_is_fast(task: str, least: float, failures: int):
    episodes = list(RolloutJob(config(task), label="last").run(stream_seeds("training", 40)))
    assert sum(not episode.success_at_end for episode in episodes) <= failures
    assert np.mean([episode.columns["next.reward"].sum() for episode in episodes]) > least
