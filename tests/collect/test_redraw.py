"""A redrawn state is another scene around the same hand, labelled by the expert, the same for the same seed."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.expert import Expert
from manip_il.collect.job import RolloutJob
from manip_il.collect.redraw import CHUNK, STATES, RedrawJob, write_states
from manip_il.data import schema
from manip_il.data.episodes import parts
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import Episode, State
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.scene import build_scene
from manip_il.sim.variation import drawn_in
from manip_il.sim.world import World

from ..tables import one_arm_per_task

CAMERAS = CameraConfig(("front", "wrist"), 32, 32)


def visited(env: EnvConfig, folder: Path, episodes: int = 2) -> Path:
    """A dataset of what the expert does with a third of its steps random."""
    job = RolloutJob(env, hold=5, conditions=(Condition("noise", random_actions=(0.3, 0.3)),))
    driven = sorted(job.run(stream_seeds("demonstrations", episodes)), key=lambda one: one.seed)
    root = folder / "visited"
    write_dataset(driven, root, env_spec(env), repo_id="local/v", fingerprint=env_fingerprint(env))
    return root


def redraw(env: EnvConfig, folder: Path, frames: int = 2 * CHUNK, **settings) -> list[Episode]:
    job = RedrawJob(env, CAMERAS, folder, frames, **settings)
    return list(job.run(list(job.seeds)))


@pytest.fixture(scope="module")
def states(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("redraw")
    write_states(visited(EnvConfig(), folder), folder, seed=0)
    return folder


def column(episodes: list[Episode], key: str) -> np.ndarray:
    return np.concatenate([episode.columns[key] for episode in episodes])


@pytest.mark.gl
@pytest.mark.parametrize(("robot", "task"), one_arm_per_task())
def test_redrawn_scenes_are_sound_and_their_labels_are_the_experts(robot: str, task: str, tmp_path):
    env = EnvConfig(robot, task)
    write_states(visited(env, tmp_path, episodes=1), tmp_path, seed=0)
    before = np.load(tmp_path / STATES)
    episodes = redraw(env, tmp_path)
    scene = build_scene(robot, task)
    expert, world = Expert(scene), World(scene)
    valid, anew = column(episodes, schema.LABEL_VALID).ravel(), 0
    assert valid.mean() > 0.8
    rows = zip(column(episodes, schema.SIM_STATE), column(episodes, schema.ACTION), valid, strict=True)
    for number, (row, action, sound) in enumerate(rows):
        state, original = State.from_vector(row), State.from_vector(before[number % len(before)])
        label = expert.label(state)
        assert label.valid == sound
        np.testing.assert_array_equal(label.action.astype(np.float32), action)
        world.restore(original.physics, original.variation)
        arm = world.data.qpos[scene.arm_q].copy()
        world.restore(state.physics, state.variation)
        np.testing.assert_array_equal(world.data.qpos[scene.arm_q], arm)  # the hand stays where it was
        anew += not np.array_equal(state.physics, original.physics)
    assert anew >= len(valid) / 5  # a hand at the furniture leaves it alone


@pytest.mark.gl
def test_a_held_object_stays_in_the_hand_and_others_do_not_overlap(states):
    before = np.load(states / STATES)
    scene = build_scene("panda", "pick_place")
    world, moved, new_goals = World(scene), 0, 0
    for number, row in enumerate(column(redraw(EnvConfig(), states, frames=4 * CHUNK), schema.SIM_STATE)):
        original = State.from_vector(before[number % len(before)])
        world.restore(original.physics, original.variation)
        was, goal, held = world.pose("object").position.copy(), world.goal.copy(), world.touched("object")
        state = State.from_vector(row)
        world.restore(state.physics, state.variation)
        shift = math.dist(was, world.pose("object").position)
        if held:
            assert shift == 0.0
        moved += shift > 0
        new_goals += not np.array_equal(goal, world.goal)
        mujoco.mj_collision(world.model, world.data)
        if shift:
            geom = scene.objects["object"].geom
            assert all(contact.dist > -2e-3 for contact in world.data.contact if geom in contact.geom)
    assert moved >= 10
    assert new_goals >= 60


@pytest.mark.gl
def test_the_same_seed_gives_the_same_bytes_and_more_frames_begin_with_the_same(states):
    few, again, more = (redraw(EnvConfig(), states, frames) for frames in (CHUNK + 3, CHUNK + 3, 2 * CHUNK))
    other = redraw(EnvConfig(), states, CHUNK, seed=1)
    assert [len(episode) for episode in few] == [CHUNK, 3]
    for key in few[0].columns:
        np.testing.assert_array_equal(column(few, key), column(again, key))
        if key != schema.SEED:
            np.testing.assert_array_equal(column(few, key), column(more, key)[: CHUNK + 3])
    assert not np.array_equal(few[0].columns[schema.SIM_STATE], other[0].columns[schema.SIM_STATE])


@pytest.mark.gl
def test_every_frame_is_an_episode_and_a_branch_is_one_of_its_steps(states):
    (single,), (branched,) = redraw(EnvConfig(), states, 4), redraw(EnvConfig(), states, 4, branch_steps=3)
    assert [len(part) for part in parts(single)] == [1] * 4
    assert [len(part) for part in parts(branched)] == [3] * 4
    for one, three in zip(parts(single), parts(branched), strict=True):
        np.testing.assert_array_equal(one.columns[schema.ACTION][0], three.columns[schema.ACTION][0])
        np.testing.assert_array_equal(three.columns[schema.ACTION], three.columns[schema.EXECUTED_ACTION])


@pytest.mark.gl
def test_pictures_are_those_of_the_redrawn_state(states):
    (episode,) = redraw(EnvConfig(), states, 5, conditions=(Condition("looks", colour=(0, 1), clutter=(2, 4)),))
    env = ManipEnv.of(EnvConfig(), CAMERAS)
    colours = set()
    for row in range(5):
        env.set_state(State.from_vector(episode.columns[schema.SIM_STATE][row]))
        for camera, picture in env.observe().images.items():
            np.testing.assert_array_equal(picture, episode.columns[schema.IMAGES + camera][row])
        drawn = drawn_in(env.world.variation, env.scene.nominal)
        assert 2 <= drawn["clutter"][0] <= 4
        colours.add(tuple(drawn["colour"]))
    assert len(colours) == 5


@pytest.mark.gl
def test_states_as_they_were_visited_keep_goals_and_objects(states):
    before = np.load(states / STATES)
    rows = column(redraw(EnvConfig(), states, CHUNK, scenes=False), schema.SIM_STATE)
    for row, original in zip(rows, before, strict=False):
        np.testing.assert_array_equal(State.from_vector(row).physics, State.from_vector(original).physics)


@pytest.mark.gl
def test_furniture_moves_where_nothing_touches_it(tmp_path):
    env, world = EnvConfig("panda", "press"), World(build_scene("panda", "press"))
    write_states(visited(env, tmp_path, episodes=1), tmp_path, seed=0)
    before = np.load(tmp_path / STATES)
    moved = 0
    for number, row in enumerate(column(redraw(env, tmp_path), schema.SIM_STATE)):
        places = []
        for state in (State.from_vector(before[number % len(before)]), State.from_vector(row)):
            world.restore(state.physics, state.variation)
            places.append(world.pose("button").position.copy())
        moved += not np.array_equal(*places)
    assert moved >= 5


@pytest.mark.parametrize(("settings", "words"), [({"frames": 0}, "frames is 0"), ({"branch_steps": 0}, "branch_steps")])
def test_what_cannot_be_is_refused(settings, words: str, tmp_path):
    with pytest.raises(UsageError, match=words):
        RedrawJob(EnvConfig(), CAMERAS, tmp_path, **{"frames": 1, **settings})


def test_states_that_are_damaged_are_named(tmp_path):
    (tmp_path / STATES).write_bytes(b"nothing")
    with pytest.raises(ManipError, match=r"cannot read .*states\.npy"):
        redraw(EnvConfig(), tmp_path)
