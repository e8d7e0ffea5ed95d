"""Sort: what is named is a function of the state, in words and in numbers, and the other cubes
are left alone.
"""

from functools import cache

import numpy as np
import pytest

from manip_il import Expert
from manip_il.collect.edits import SceneDrawer, Scenes
from manip_il.collect.job import RolloutJob
from manip_il.mdp import State
from manip_il.sim.env import environment_state_names
from manip_il.sim.events import move_object
from manip_il.sim.world import World
from manip_il.tasks.objects import UPRIGHT
from manip_il.tasks.sort import BINS, COLOURS, PITCH, SENTENCES, asked
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import make_env
from manip_il.worlds.table import make_config

from ..scenes import SEED, drive, drive_until, solve, started
from ..tables import every_large_robot

STARTS = range(SEED, SEED + 100)


@cache
def starts() -> list[tuple[str, str, State]]:
    env, found = make_env("panda", "sort"), []
    for seed in STARTS:
        env.start(seed)
        found.append((asked(env.world), env.task_description, env.get_state()))
    return found


def others(world: World) -> list[str]:
    return [name for name in COLOURS if name != asked(world)]


def test_every_cube_is_named_in_every_sentence():
    assert {text for _, text, _ in starts()} == {
        text.format(colour=colour) for text in SENTENCES for colour in COLOURS
    }
    assert all(name in text for name, text, _ in starts())


def test_a_restored_state_says_the_same_in_words_and_numbers():
    env, names = make_env("panda", "sort"), environment_state_names(started(task="sort").scene)
    for name, text, state in starts()[:20]:
        env.set_state(State.from_vector(state.to_vector()))
        seen = env.observe()
        assert (asked(env.world), seen.instruction, env.task_description) == (name, text, text)
        numbers = dict(zip(names, seen.environment_state.tolist(), strict=True))
        assert [numbers[f"asked.{colour}"] for colour in COLOURS] == [
            colour == name for colour in COLOURS
        ]
        x = env.world.at(BINS[name])[0] - env.world.at(name)[0]
        assert numbers["bin_from_cube.x"] == pytest.approx(x, abs=1e-6)


def test_a_knock_moves_the_cube_that_is_named():
    env = make_env("panda", "sort")
    for name, _, state in starts()[:10]:
        env.set_state(state)
        before = env.world.pose(name).position.copy()
        move_object(env.world, np.random.default_rng(0), (0.05, 0.08))
        assert 0.05 <= np.linalg.norm((env.world.pose(name).position - before)[:2]) <= 0.08


def test_redrawn_bins_stand_in_a_row():
    env = make_env("panda", "sort")
    drawer = SceneDrawer(make_config("panda", "sort"), Scenes(None, 20))
    for number, (_, _, state) in enumerate(starts()[:20]):
        for frame in drawer.frames(state, number, 0):
            env.set_state(frame.state)
            bins = np.array(sorted(env.world.pose(one).position.tolist() for one in BINS.values()))
            np.testing.assert_allclose(np.diff(bins, axis=0), [[PITCH, 0, 0]] * 2, atol=1e-9)


@every_large_robot
def test_an_episodes_text_is_that_of_its_state(robot: str):
    world = started(robot, "sort").world
    for episode in RolloutJob(make_config(robot, "sort", horizon=6)).run(STARTS[:3]):
        state = State.from_vector(episode.columns["sim_state"][-1])
        world.restore(state.physics, state.variation)
        assert episode.instruction == TASKS["sort"].instruction_in(world)


@every_large_robot
def test_the_cube_that_is_named_ends_in_its_bin_and_the_others_where_they_were(robot: str):
    env = started(robot, "sort")
    before = {name: env.world.pose(name).position.copy() for name in COLOURS}
    solve(env)
    for name in others(env.world):
        np.testing.assert_allclose(env.world.pose(name).position, before[name], atol=1e-3)
    wrong = others(env.world)[0]
    env.world.place(wrong, env.world.pose(BINS[wrong]).position + [0.0, 0.0, 0.03], UPRIGHT)
    env.world.update()
    assert env.distance() > env.config.tolerance
    assert env.progress < 1


def test_a_cube_that_is_not_named_may_be_anywhere():
    env = started(task="sort")
    env.world.place(others(env.world)[0], np.array([-2.0, 0.0, -0.3]), UPRIGHT)
    assert Expert(env.scene).label(env.get_state()).valid
    env.world.place(asked(env.world), np.array([-2.0, 0.0, -0.3]), UPRIGHT)
    assert Expert(env.scene).label(env.get_state()).reason == f"{asked(env.world)} off the table"


@pytest.mark.parametrize("number", [1, 2])
def test_a_cube_that_is_not_named_is_put_back(number: int):
    env = started(task="sort")
    drive_until(env, "carry")
    held = asked(env.world)
    drive(env, 8)
    now = (list(COLOURS).index(held) + number) % len(COLOURS)
    env.world.place("asked", np.array([float(now), 0.0, 0.0]), UPRIGHT)
    env.world.update()
    assert solve(env)[0] == "put_back"
    assert env.world.pose(held).position[2] == pytest.approx(0.018, abs=0.002)
