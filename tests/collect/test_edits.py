"""Datasets made of stored states: labels are the expert's, pictures those of recording, scenes
sound.
"""

import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from kept import label_all

from manip_il import Expert
from manip_il.collect.edits import (
    CHUNK,
    SERVED,
    EditSource,
    EditTarget,
    Scenes,
    open_source,
    redraw_dataset,
    relabel_dataset,
    render_dataset,
    render_states,
)
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import map_in_order
from manip_il.data import schema
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError
from manip_il.mdp import Episode, State
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig, Look
from manip_il.sim.variation import part
from manip_il.sim.world import World
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.ladder.world import LadderEnv, scene_of
from manip_il.worlds.table import env_fingerprint, env_spec, make_config, make_expert

from ..damage import digests
from ..pictures import read_episodes
from ..tables import SCENES, one_arm_per_task

ENV, REACH = make_config("panda", "pick_place"), make_config("fetch", "reach")
CAMERAS, SMALL = CameraConfig(("front", "wrist"), 64, 96), CameraConfig(("front", "wrist"), 32, 32)
NOISE = Condition("noise", random_actions=(0.3, 0.3))


def recorded(env: EnvConfig, count: int = 2, **settings) -> list[Episode]:
    job = RolloutJob(env, hold=0, **settings)
    return sorted(job.run(stream_seeds("demonstrations", count)), key=lambda episode: episode.seed)


def write(
    episodes: list[Episode],
    root: Path,
    env: EnvConfig,
    cameras: CameraConfig | None = None,
    **provenance,
) -> Path:
    about = {"fingerprint": env_fingerprint(env, cameras), "provenance": {"round": 3, **provenance}}
    write_dataset(episodes, root, env_spec(env, cameras), **about)
    return root


def changed(episode: Episode, **columns: np.ndarray) -> Episode:
    return replace(episode, columns={**episode.columns, **columns})


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> Path:
    return write(recorded(ENV), tmp_path_factory.mktemp("source") / "demos", ENV)


@pytest.fixture(scope="module")
def visited(tmp_path_factory) -> EditSource:
    """What the expert does with a third of its steps random."""
    episodes = recorded(ENV, conditions=(NOISE,))
    return open_source(write(episodes, tmp_path_factory.mktemp("visited") / "visited", ENV))


def test_a_datasets_rate_is_its_environments(tmp_path):
    env = make_config("panda", "reach", 10)
    assert open_source(write(recorded(env, 1), tmp_path / "slow", env)).env == env


@pytest.mark.slow
def test_labels_given_afterwards_elsewhere_in_another_order_are_those_given_while_recording():
    envs = [make_config(*scene) for scene in SCENES]
    pieces = [(env, episode) for env in envs for episode in recorded(env, 1, conditions=(NOISE,))]
    with closing(map_in_order(label_all, pieces, 2)) as labelled:
        for (_, episode), found in labelled:
            for key, labels in found.items():
                np.testing.assert_array_equal(
                    labels.reshape(episode.columns[key].shape), episode.columns[key]
                )


@pytest.mark.parametrize(
    "env", [REACH, make_config("fetch_stock", "FetchReach-v4")], ids=lambda env: env.robot
)
def test_relabelling_gives_the_labels_of_today(env: EnvConfig, tmp_path):
    [first, second] = recorded(env)
    older = {key: first.columns[key].copy() for key in (schema.ACTION, schema.EXPERT_PHASE)}
    older[schema.ACTION][0, 0] += 0.05
    older[schema.EXPERT_PHASE][1] += 1
    bare = {
        key: np.zeros_like(second.columns[key])
        for key in (schema.ACTION, schema.LABEL_VALID, schema.EXPERT_PHASE)
    }
    root = write([changed(first, **older), changed(second, **bare)], tmp_path / "older", env)
    whole = write([first, second], tmp_path / "whole", env)
    relabel_dataset(open_source(root), EditTarget(tmp_path / "new", workers=2))
    new, expected = Dataset.open(tmp_path / "new"), Dataset.open(whole)
    for key, column in expected.columns().items():
        np.testing.assert_array_equal(new.columns()[key], column)
    assert (new.root / "meta/stats.json").read_bytes() == (whole / "meta/stats.json").read_bytes()
    assert (new.provenance["round"], new.provenance["relabelled"]["from"]) == (3, "older")


@pytest.mark.gl
@pytest.mark.parametrize("robot", ["panda", "fetch"])
def test_pictures_made_afterwards_are_those_made_while_recording(robot: str):
    env = make_config(robot)
    for episode in recorded(env, 1, cameras=CAMERAS):
        pictures, spec = (
            render_states(env, CAMERAS, episode.columns[schema.SIM_STATE]),
            env_spec(env, CAMERAS),
        )
        assert set(pictures) == {*spec.image_keys, *spec.keypoint_keys}
        for key, frames in pictures.items():
            np.testing.assert_array_equal(frames, episode.columns[key])
            assert not np.array_equal(frames[0], frames[-1])


@pytest.mark.gl
@pytest.mark.slow
def test_a_dataset_gets_other_pictures_and_keeps_everything_else(demos, tmp_path):
    dim, once = CameraConfig(("wrist",), 32, 48, Look(brightness=0.5)), tmp_path / "pictured"
    render_dataset(open_source(demos), CAMERAS, EditTarget(once, workers=2))
    render_dataset(open_source(once), dim, EditTarget(tmp_path / "dim"))
    relabel_dataset(open_source(once), EditTarget(tmp_path / "relabelled"))
    assert digests(once / "videos") == digests(tmp_path / "relabelled" / "videos") != {}
    before = Dataset.open(demos)
    for root, cameras in ((once, CAMERAS), (tmp_path / "dim", dim)):
        after, spec = Dataset.open(root), env_spec(ENV, cameras)
        assert after.columns().keys() == before.columns().keys() | spec.keypoint_keys.keys()
        for key, column in before.columns().items():
            np.testing.assert_array_equal(after.columns()[key], column)
        assert (after.spec, after.fingerprint) == (spec, env_fingerprint(ENV, cameras))
        for episode in read_episodes(root):
            exact = render_states(ENV, cameras, episode.columns[schema.SIM_STATE])
            for key in spec.image_keys:  # but for what the video's compression costs
                assert np.abs(episode.columns[key].astype(int) - exact[key]).mean() < 4


def redrawn(
    source: EditSource, root: Path, frames: int, workers: int = 1, **settings
) -> list[Episode]:
    redraw_dataset(source, Scenes(SMALL, frames, **settings), EditTarget(root, workers))
    return list(read_episodes(root))


def originals(source: EditSource, seed: int = 0) -> list[State]:
    states = source.dataset.columns([schema.SIM_STATE])[schema.SIM_STATE]
    order = rng_for(seed, "order of redrawn states").permutation(len(states))
    return [State.from_vector(row) for row in states[order]]


def world_in(world: World, state: State) -> World:
    world.restore(state.physics, state.variation)
    return world


@pytest.mark.gl
@pytest.mark.parametrize(("robot", "task"), one_arm_per_task())
def test_redrawn_scenes_are_other_scenes_around_the_same_hand_with_the_experts_label(
    robot: str, task: str, tmp_path
):
    env, scene = make_config(robot, task), scene_of(robot, task)
    source = open_source(write(recorded(env, 1, conditions=(NOISE,)), tmp_path / "visited", env))
    frames, expert, world = (
        CHUNK if task != "pick_place" else 2 * CHUNK,
        Expert(scene),
        World(scene),
    )
    episodes = redrawn(source, tmp_path / "new", frames)
    hands = {
        tuple(world_in(world, state).data.qpos[scene.arm_q]): state for state in originals(source)
    }
    anew, moved = 0, 0
    for episode in episodes:
        state = State.from_vector(episode.columns[schema.SIM_STATE][0])
        label = expert.label(state)
        assert len(episode) == label.valid == 1
        np.testing.assert_array_equal(
            label.action.astype(np.float32), episode.columns[schema.ACTION][0]
        )
        before = hands[tuple(world_in(world, state).data.qpos[scene.arm_q])]
        anew += not np.array_equal(state.physics, before.physics)
        for name, one in scene.objects.items() if task == "pick_place" else ():
            was, held = world_in(world, before).pose(name).position.copy(), world.touched(name)
            mujoco.mj_collision(world.model, world_in(world, state).data)
            if math.dist(was, world.pose(name).position):
                assert not held
                assert all(
                    contact.dist > -2e-3
                    for contact in world.data.contact
                    if one.geom in contact.geom
                )
                moved += 1
    assert len(episodes) > 0.8 * frames
    assert anew >= len(episodes) / 5  # a hand at the furniture leaves it alone
    assert moved >= 5 or task != "pick_place"


def test_labels_with_the_servos_sag_keep_it_in_redrawn_scenes_and_lose_it_nowhere(tmp_path):
    (episode,) = recorded(REACH, 1)
    sagging = changed(episode, action=np.add(episode.columns["action"], 0.01, dtype=np.float32))
    about = {"merged": [{"provenance": {"driver": SERVED}}]}
    served = open_source(write([sagging], tmp_path / "served", REACH, **about))
    redraw_dataset(served, Scenes(None, 30), EditTarget(tmp_path / "redrawn"))
    expert = make_expert(REACH)
    for scene in read_episodes(tmp_path / "redrawn"):
        label = expert.label(State.from_vector(scene.columns["sim_state"][0]))
        np.testing.assert_allclose(scene.columns["action"][0] - label.action, 0.01, atol=1e-6)
    with pytest.raises(ManipError, match="sag"):
        relabel_dataset(served, EditTarget(tmp_path / "relabelled"))
    with pytest.raises(ManipError, match="sag"):
        redraw_dataset(served, Scenes(None, 3, branch_steps=2), EditTarget(tmp_path / "branches"))


def test_redrawn_scenes_are_observed_with_noise(visited, tmp_path):
    noisy = Scenes(None, 10, conditions=(Condition("noise", joint_noise=0.05),))
    redraw_dataset(visited, noisy, EditTarget(tmp_path / "noisy"))
    env = LadderEnv(visited.env)
    for scene in read_episodes(tmp_path / "noisy"):
        env.set_state(State.from_vector(scene.columns["sim_state"][0]))
        assert (
            0.01 < np.abs(scene.columns["observation.state"][0] - env.observe().state).max() < 0.5
        )


@pytest.mark.gl
@pytest.mark.slow
def test_redrawing_depends_on_the_seed_alone_and_more_frames_begin_with_the_same(visited, tmp_path):
    once = redrawn(visited, tmp_path / "1" / "new", CHUNK + 3)
    redrawn(visited, tmp_path / "2" / "new", CHUNK + 3, workers=2)
    assert digests(tmp_path / "1" / "new") == digests(tmp_path / "2" / "new")
    more, other = (
        redrawn(visited, tmp_path / "more", 2 * CHUNK),
        redrawn(visited, tmp_path / "other", 5, seed=1),
    )
    for one, same in zip(once, more, strict=False):
        for key in (schema.ACTION, schema.SIM_STATE, schema.IMAGES + "wrist"):
            np.testing.assert_array_equal(one.columns[key], same.columns[key])
    assert not np.array_equal(once[0].columns[schema.SIM_STATE], other[0].columns[schema.SIM_STATE])


@pytest.mark.gl
def test_a_branch_is_the_experts_next_steps_and_looks_are_those_of_the_state(visited, tmp_path):
    looks = (Condition("looks", colour=(0, 1), clutter=(2, 4)),)
    single = redrawn(visited, tmp_path / "1", 4, conditions=looks)
    branches = redrawn(visited, tmp_path / "3", 4, branch_steps=3, conditions=looks)
    env, colours = LadderEnv(ENV, SMALL), set()
    for one, three in zip(single, branches, strict=True):
        assert (len(one), len(three)) == (1, 3)
        np.testing.assert_array_equal(
            one.columns[schema.ACTION][0], three.columns[schema.ACTION][0]
        )
        np.testing.assert_array_equal(
            three.columns[schema.ACTION], three.columns[schema.EXECUTED_ACTION]
        )
        env.set_state(State.from_vector(one.columns[schema.SIM_STATE][0]))
        for camera, picture in env.observe().images.items():
            np.testing.assert_array_equal(picture, one.columns[schema.IMAGES + camera][0])
        colours.add(tuple(part(env.world.variation, "colour")))
    assert len(colours) == 4
    kept = redrawn(visited, tmp_path / "kept", 5, anew=False)
    for episode, original in zip(kept, originals(visited), strict=False):
        np.testing.assert_array_equal(
            State.from_vector(episode.columns[schema.SIM_STATE][0]).physics, original.physics
        )
