"""Pictures of recorded states are those that recording would have made; nothing else of a dataset changes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.expert import Expert
from manip_il.collect.job import RolloutJob
from manip_il.collect.record import provenance
from manip_il.collect.render import render_dataset, render_episodes, render_states
from manip_il.collect.source import open_source, recorded_conditions
from manip_il.data import schema
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_write import write_dataset
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import Episode, State
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig, Look
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.scene import build_scene

ENV = EnvConfig("panda", "pick_place")
CAMERAS = CameraConfig(("front", "wrist"), 64, 96)
PROVENANCE = {"driver": "expert", "round": 0}


def episodes(count: int, cameras: CameraConfig | None = None, env: EnvConfig = ENV) -> list[Episode]:
    job = RolloutJob(env, hold=0, cameras=cameras)
    return sorted(job.run(stream_seeds("demonstrations", count)), key=lambda episode: episode.seed)


@pytest.fixture(scope="module")
def blind() -> list[Episode]:
    return episodes(3)


@pytest.fixture
def source(blind, tmp_path) -> Path:
    root = tmp_path / "demos"
    fingerprint = env_fingerprint(ENV)
    write_dataset(blind, root, env_spec(ENV), repo_id="local/demos", fingerprint=fingerprint, provenance=PROVENANCE)
    return root


def change(root: Path, **entries: object) -> None:
    """Of the spec or the fingerprint in the dataset's own file."""
    path = root / "meta" / "manip_il.json"
    ours = json.loads(path.read_text())
    for key, value in entries.items():
        part = ours["spec"] if key in ours["spec"] else ours["fingerprint"]
        part[key] = value
    path.write_text(json.dumps(ours))


@pytest.mark.gl
@pytest.mark.parametrize("robot", ["panda", "fetch"])
def test_pictures_made_afterwards_are_those_made_while_recording(robot):
    env = EnvConfig(robot)
    recorded = episodes(2, CAMERAS, env)
    for episode in recorded:
        pictures = render_states(env, CAMERAS, episode.columns[schema.SIM_STATE])
        spec = env_spec(env, CAMERAS)
        assert set(pictures) == {*spec.image_keys, *spec.keypoint_keys}
        for key, frames in pictures.items():
            seen = key in spec.image_keys
            assert frames.shape == (len(episode), *((64, 96, 3) if seen else (3 * len(spec.keypoints),)))
            np.testing.assert_array_equal(frames, episode.columns[key])
            assert not np.array_equal(frames[0], frames[-1])


@pytest.mark.gl
@pytest.mark.slow
def test_two_workers_give_the_episodes_of_one_in_order(blind):
    one, two = (list(render_episodes(blind, ENV, CAMERAS, workers)) for workers in (1, 2))
    assert [episode.seed for episode in two] == [episode.seed for episode in blind]
    for left, right in zip(one, two, strict=True):
        assert left.columns.keys() == right.columns.keys()
        for key, column in left.columns.items():
            np.testing.assert_array_equal(right.columns[key], column)


@pytest.mark.gl
@pytest.mark.slow
def test_a_dataset_gains_pictures_and_keeps_everything_else(source, tmp_path):
    written: list[Episode] = []
    target = tmp_path / "pictured"
    info = render_dataset(open_source(source), target, CAMERAS, repo_id="local/p", on_episode=written.append)
    assert [episode.seed for episode in written] == [episode.seed for episode in Dataset.open(source).read_episodes()]
    assert info.episodes == 3
    before, after = Dataset.open(source).columns(), Dataset.open(info.root).columns()
    assert after.keys() == before.keys() | env_spec(ENV, CAMERAS).keypoint_keys.keys()
    for key, column in before.items():
        np.testing.assert_array_equal(after[key], column)
    assert Dataset.open(info.root).spec == env_spec(ENV, CAMERAS)
    assert Dataset.open(info.root).fingerprint == env_fingerprint(ENV, CAMERAS)
    provenance = Dataset.open(info.root).provenance
    rendered = provenance["rendered"]
    assert provenance == {**PROVENANCE, "rendered": rendered}
    assert rendered["from"] == "demos"
    assert rendered["cameras"]["look"] == {"shadows": False, "brightness": 1.0, "light_turn": 0.0}


@pytest.mark.gl
@pytest.mark.slow
def test_a_dataset_with_pictures_gets_other_ones(source, tmp_path):
    pictured, dim = tmp_path / "pictured", CameraConfig(("wrist",), 32, 48, Look(brightness=0.5))
    render_dataset(open_source(source), pictured, CAMERAS, repo_id="local/p")
    info = render_dataset(open_source(pictured), tmp_path / "dim", dim, repo_id="local/dim")
    assert Dataset.open(info.root).spec == env_spec(ENV, dim)
    assert Dataset.open(info.root).fingerprint == env_fingerprint(ENV, dim)
    for episode in Dataset.open(info.root).read_episodes():
        images = [key for key in episode.columns if key.startswith(schema.IMAGES)]
        assert images == [schema.IMAGES + "wrist"]
        exact = render_states(ENV, dim, episode.columns[schema.SIM_STATE])[images[0]]
        assert np.abs(episode.columns[images[0]].astype(int) - exact).mean() < 4  # what the video's compression costs


@pytest.mark.gl
def test_what_was_there_goes_only_once_the_new_dataset_is_whole(source, tmp_path):
    target = tmp_path / "target"
    source.rename(target)
    write_dataset(Dataset.open(target).read_episodes(), source, env_spec(ENV), repo_id="local/d", fingerprint={})
    before = Dataset.open(target).provenance

    def stop(_: Episode) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_dataset(open_source(source), target, CAMERAS, repo_id="local/d", replace=True, on_episode=stop)
    assert Dataset.open(target).provenance == before == PROVENANCE
    assert sorted(path.name for path in tmp_path.iterdir()) == ["demos", "target"]


def test_another_compiled_model_is_a_warning_that_names_both_sides(source):
    assert open_source(source).warnings == ()
    change(source, model_sha256="0" * 64, torch="1.0")
    (warning,) = open_source(source).warnings
    assert "compiled MuJoCo model differs" in warning
    assert str(source) in warning
    assert "this machine" in warning


@pytest.mark.parametrize(
    ("entry", "kind", "words"),
    [
        ({"robot": "ur5"}, ManipError, "for the robot 'ur5', which is not known here .known: panda, fetch.*"),
        ({"task": "juggle"}, ManipError, "for the task 'juggle', which is not known here"),
        ({"sim_state_size": 7}, MismatchError, "size of sim_state differs: .* has 7, this program has"),
    ],
)
def test_states_of_an_unknown_world_are_refused(source, entry, kind, words):
    change(source, **entry)
    with pytest.raises(kind, match=words):
        open_source(source)


def test_what_does_not_name_its_task_or_is_no_dataset_is_refused(source, tmp_path):
    (source / "meta" / "manip_il.json").unlink()  # LeRobot's tools leave it out
    for folder, words in ((source, r"meta/manip_il\.json is missing"), (tmp_path, "is not a LeRobot dataset")):
        with pytest.raises(ManipError, match=words):
            open_source(folder)


def test_the_provenance_says_what_episodes_drew_from_and_merging_keeps_it():
    varied = Condition("varied", size=(0.03, 0.07), brightness=(0.5, 1.0))
    origin = json.loads(json.dumps(provenance(RolloutJob(ENV, conditions=(varied,)))))
    plain = provenance(RolloutJob(ENV))
    here = Path("demos")
    assert recorded_conditions(here, origin) == (varied,)
    assert recorded_conditions(here, plain) == ()
    assert recorded_conditions(here, {"merged": [{"name": "a", "provenance": origin}] * 2}) == (varied,)
    with pytest.raises(ManipError, match="datasets that vary in different ways"):
        recorded_conditions(here, {"merged": [{"provenance": origin}, {"provenance": plain}]})


def test_varied_episodes_have_their_draws_in_every_state_and_the_experts_labels_of_it():
    varied = Condition("varied", size=(0.03, 0.07), mass=(0.05, 0.3))
    env, expert = ManipEnv.of(ENV), Expert(build_scene(ENV.robot, ENV.task))
    job = RolloutJob(ENV, hold=0, conditions=(varied,))
    for episode in job.run(stream_seeds("demonstrations", 2)):
        drawn = varied.draw(episode.seed).values
        for state, action in zip(episode.columns[schema.SIM_STATE], episode.columns[schema.ACTION], strict=True):
            env.set_state(State.from_vector(state))
            assert env.world.extents("object") == pytest.approx([drawn["size"]] * 3)
            assert env.world.variation[3] == drawn["mass"]
            np.testing.assert_array_equal(expert.label(env.get_state()).action.astype(action.dtype), action)
