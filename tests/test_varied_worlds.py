"""Worlds that vary: every draw is in the state and in the episode, labels and steps of a
restored state are its own.
"""

from pathlib import Path

import numpy as np
import pytest

from manip_il import Expert
from manip_il.bridges.doctor.examine import examine_folder
from manip_il.collect.edits import render_states
from manip_il.collect.job import RolloutJob
from manip_il.data import schema
from manip_il.data.build import build
from manip_il.data.journal import Journal, read_journal
from manip_il.evaluation.suites import varied
from manip_il.mdp import Episode, State
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import ManipEnv
from manip_il.sim.shape import KINDS as SHAPES
from manip_il.sim.variation import with_drawn
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import env_fingerprint, env_spec, make_config

from .pictures import read_episodes
from .tables import SCENES

KINDS = ("object", "view", "dynamics")
REACH = make_config("panda", "reach", horizon=6, success_steps=1)


def condition(env: EnvConfig, *kinds: str) -> Condition:
    [found] = varied(
        [kind for kind in kinds if kind != "object" or env.task != "reach"], env, sees=True
    )
    return found


def path_of(env: ManipEnv, state: State, steps: int) -> list[bytes]:
    """States and labels from a state on, under the expert."""
    expert, path = Expert(env.scene), []
    env.set_state(state)
    for _ in range(steps):
        label = expert.label(env.get_state())
        path += [env.get_state().to_vector().tobytes(), label.action.tobytes()]
        env.advance(label.action)
    return path


@pytest.mark.parametrize(
    ("robot", "task", "shape"), [*((*scene, "") for scene in SCENES), ("panda", "lift", "any")]
)
def test_a_restored_state_is_the_same_world_with_the_same_labels(robot: str, task: str, shape: str):
    config = make_config(robot, task, object=shape)
    env = LadderEnv(config, None, [condition(config, *KINDS)])
    env.start(7)
    for _ in range(3):
        env.advance(Expert(env.scene).label(env.get_state()).action)
    vector = env.get_state().to_vector()
    plain = LadderEnv(config)
    plain.start(8)
    restored = State.from_vector(vector)
    assert path_of(plain, restored, 4) == path_of(env, State.from_vector(vector), 4)
    np.testing.assert_array_equal(
        plain.get_state().variation, with_drawn(plain.scene.nominal, env.drawn)
    )


@pytest.mark.gl
@pytest.mark.parametrize("shape", ["", "any"])
def test_pictures_of_restored_states_are_those_of_their_own_world(shape: str):
    config, cameras = (
        make_config("panda", "pick_place", object=shape),
        CameraConfig(("front", "wrist"), 32, 32),
    )
    env, plain = LadderEnv(config, cameras, [condition(config, *KINDS)]), LadderEnv(config, cameras)
    plain.start(2)
    before = plain.observe().images["front"]
    for seed in (1, 2):
        env.start(seed)
        seen, state = env.observe().images, env.get_state().to_vector()
        made = render_states(config, cameras, state[None])
        for name, picture in seen.items():
            np.testing.assert_array_equal(made[schema.IMAGES + name][0], picture)
    plain.set_state(State.from_vector(state))
    np.testing.assert_array_equal(plain.observe().images["front"], seen["front"])
    plain.start(2)
    np.testing.assert_array_equal(plain.observe().images["front"], before)
    assert not np.array_equal(before, seen["front"])


@pytest.fixture(scope="module", params=[("", KINDS), ("any", ("object",)), ("any", ())], ids=str)
def world(request) -> tuple[EnvConfig, list[Episode]]:
    shape, kinds = request.param
    config = make_config("panda", "pick_place", horizon=12, object=shape)
    job = RolloutJob(config, conditions=(condition(config, *kinds),) if kinds else ())
    return config, list(job.run([3, 4]))


def test_an_episode_names_its_draws_and_journal_and_dataset_keep_them(
    world: tuple[EnvConfig, list[Episode]], tmp_path: Path
):
    config, episodes = world
    spec, fingerprint = env_spec(config), env_fingerprint(config)
    for episode in episodes:
        path = Journal(tmp_path / "varied.journals", spec, fingerprint).write(episode)
        assert read_journal(path)[1].drawn == episode.drawn != {}
        state = State.from_vector(episode.columns[schema.SIM_STATE][0])
        np.testing.assert_array_equal(
            state.variation, with_drawn(LadderEnv(config).scene.nominal, episode.drawn)
        )
    build(tmp_path / "varied.journals", tmp_path / "varied")
    assert [one.drawn for one in read_episodes(tmp_path / "varied")] == [
        one.drawn for one in episodes
    ]
    assert examine_folder(tmp_path / "varied") == []


def test_episodes_of_any_shape_say_which_they_have():
    config = make_config("panda", "pick_place", object="any", horizon=1, success_steps=1)
    assert {episode.drawn["shape"] for episode in RolloutJob(config).run(range(30))} == set(SHAPES)
