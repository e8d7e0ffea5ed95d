"""Fetch's environments: as gymnasium makes them, restored bit for bit, and solved by their
experts.
"""

import gymnasium
import numpy as np
import pytest

from manip_il.collect.drivers import Driver, ExpertDriver, NoisyExpertDriver
from manip_il.collect.job import RolloutJob
from manip_il.errors import MismatchError
from manip_il.evaluation.world_check import check_world
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import lerobot_options
from manip_il.mdp import State
from manip_il.seeding import stream_seeds
from manip_il.worlds.config import WORLDS, EnvConfig
from manip_il.worlds.contract import Environment
from manip_il.worlds.fetch.environment import Fetch
from manip_il.worlds.table import env_spec, make_config, make_env

every_task = pytest.mark.parametrize("task", WORLDS[Fetch.name].tasks)


def config(task: str) -> EnvConfig:
    return make_config(Fetch.name, task, 25)


def made(task: str) -> Environment:
    return make_env(config(task))


def actions(count: int) -> np.ndarray:
    """Actions that bring the gripper down to the table."""
    drawn = np.random.default_rng(3).uniform(-1, 1, (count, 4))
    drawn[:, 2] -= 0.4
    return drawn


@every_task
def test_it_is_the_environment_that_gymnasium_makes(task: str):
    module = __import__("gymnasium_robotics")
    gymnasium.register_envs(module)
    theirs, ours = gymnasium.make(task), made(task)
    seen, _ = theirs.reset(seed=7)
    ours.start(7)
    for action in actions(Fetch.horizon):
        expected = np.append(seen["observation"], seen["desired_goal"]).astype(np.float32)
        assert np.array_equal(ours.observe().environment_state, expected)
        seen, reward, _, over, info = theirs.step(action)
        assert ours.step(action)[1:3] == (reward, bool(info["is_success"]))
        assert over == (ours.get_state().step == Fetch.horizon)


@every_task
def test_a_restored_state_goes_on_bit_for_bit(task: str):
    env, other = made(task), made(task)
    env.start(1)
    states, rows = [], []
    for action in actions(30):
        states.append(env.get_state().to_vector())
        rows.append(env.observe().environment_state)
        env.step(action)
    other.start(2)
    for begin in (0, 13, 29):
        other.set_state(State.from_vector(states[begin]))
        for step in range(begin, 30):
            assert np.array_equal(other.get_state().to_vector(), states[step])
            assert np.array_equal(other.observe().environment_state, rows[step])
            other.step(actions(30)[step])


def test_a_state_of_another_task_is_refused():
    with pytest.raises(MismatchError, match="size of the state"):
        made("FetchReach-v4").set_state(made("FetchPush-v4").get_state())


@every_task
def test_an_episode_is_50_steps_at_a_cost_of_1_outside_of_5_cm(task: str):
    [episode] = RolloutJob(config(task)).run(stream_seeds("training", 1))
    solved, rewards = (
        episode.columns["next.success"].ravel(),
        episode.columns["next.reward"].ravel(),
    )
    assert len(episode) == Fetch.horizon
    assert np.array_equal(rewards, np.where(solved, 0.0, -1.0))
    assert episode.success_at_end
    spec = env_spec(config(task))
    assert episode.columns["action"].shape[1] == len(spec.joint_names)
    assert episode.columns["sim_state"].shape[1] == spec.sim_state_size
    assert np.array_equal(episode.columns["action"], episode.columns["executed_action"])


@every_task
def test_it_keeps_the_contract(task: str):
    assert not [check for check in check_world(config(task), 3, lambda: None) if check.advice]


@every_task
def test_positions_are_those_of_the_observation(task: str):
    env = made(task)
    row = dict(
        zip(env.spec.environment_state_names, env.observe().environment_state.tolist(), strict=True)
    )
    found = env.positions()
    names = {"hand": "ee"} | ({"object": "object"} if task != "FetchReach-v4" else {})
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
    assert (
        lerobot_options(fit, env_spec(config("FetchReach-v4")).action_meaning)[1] == "joint_target"
    )
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
