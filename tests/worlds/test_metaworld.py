"""Meta-World is what LeRobot's evaluator makes of it, and its scripts label any state."""

from typing import Any

import numpy as np
import pytest
from lerobot.envs.metaworld import MetaworldEnv

from manip_il.evaluation.world_check import check_world
from manip_il.sim import render
from manip_il.sim.config import CameraConfig
from manip_il.worlds.metaworld import CAMERA, Metaworld
from manip_il.worlds.metaworld_experts import EXPERTS
from manip_il.worlds.table import make_config, make_env, make_expert

TASKS = (
    "pick-place-v3",
    "door-open-v3",
    "bin-picking-v3",
)  # objects, furniture, and memory in None


def test_all_fifty_are_known_by_lerobots_names():
    assert len(Metaworld.tasks) == 50
    assert make_config("metaworld", "peg-insert-side-v3").horizon == 500


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_is_that_of_lerobots_environment(task):
    theirs: Any = MetaworldEnv(task, obs_type="pixels_agent_pos", observation_width=96)
    config = make_config("metaworld", task)
    ours, expert = make_env(config), make_expert(config)
    seen, _ = theirs.reset(seed=1000)
    ours.start(1000)
    solved = []
    for _ in range(150):
        assert np.array_equal(ours.observe().state, seen["agent_pos"].astype(np.float32))
        action = expert.label(ours.get_state(), ours).action.astype(np.float32)
        seen, _, terminated, _, info = theirs.step(action)
        solved.append((ours.step(action).solved, info["is_success"]))
        if terminated:  # it has begun another episode
            break
    assert solved[-1] == (True, True)
    assert all(one == other for one, other in solved)


@pytest.mark.parametrize("task", TASKS)
def test_it_keeps_the_contract(task):
    found = list(check_world(make_config("metaworld", task), 2, lambda: None))
    assert not [check for check in found if check.advice]


def test_a_picture_is_that_of_lerobots_environment():
    theirs: Any = MetaworldEnv("push-v3", observation_width=96, observation_height=96)
    theirs.reset(seed=1000)
    config = make_config("metaworld", "push-v3")
    ours = make_env(config, CameraConfig((CAMERA,), 480, 480))
    ours.start(1000)
    wanted, found = theirs.render(), ours.observe().images[CAMERA]
    assert wanted.shape == found.shape
    differs = np.abs(wanted.astype(int) - found).max(axis=2) > 30
    assert differs.mean() < 0.03


def test_a_picture_does_not_depend_on_what_else_is_drawn():
    ours = make_env(make_config("metaworld", "push-v3"), CameraConfig((CAMERA,), 96, 96))
    arm = make_env(make_config("panda", "lift"), CameraConfig(("front",), 32, 48))
    ours.start(3)
    arm.start(3)
    first, of_arm = ours.observe().images[CAMERA], arm.observe().images["front"]
    for between in (lambda: None, render.close):
        between()
        assert np.array_equal(ours.observe().images[CAMERA], first)
        assert np.array_equal(arm.observe().images["front"], of_arm)


@pytest.mark.parametrize("task", EXPERTS)
def test_our_expert_recovers_from_random_actions(task):
    config = make_config("metaworld", task)
    env, expert, rng = make_env(config), make_expert(config), np.random.default_rng(0)
    env.start(3000)
    solved = False
    for _ in range(config.horizon):
        label = expert.label(env.get_state(), env)
        action = rng.uniform(-1, 1, 4) if rng.random() < 0.1 else label.action
        if solved := env.step(action).solved:
            break
    assert solved
