"""Texts of frames: true of their states, in LeRobot's form, and kept with their frames."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
from lerobot.annotations.steerable_pipeline.validator import StagingValidator
from lerobot.configs.recipe import DEFAULT_BINDINGS, TrainingRecipe
from lerobot.datasets.dataset_tools import delete_episodes
from lerobot.datasets.language_render import render_sample
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from manip_il import record
from manip_il.cli.main import main
from manip_il.collect.edits import EditTarget, open_source
from manip_il.collect.language import annotate_dataset
from manip_il.data.dataset import Dataset
from manip_il.learn.paraphrases import paraphrases
from manip_il.mdp import Actor, State
from manip_il.sim.config import CameraConfig
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import make_config, make_env, make_expert

from ..tables import one_arm_per_task

CAMERAS = CameraConfig(("front", "wrist"), 32, 32)


@pytest.fixture(scope="module")
def roots(checkpoint, tmp_path_factory) -> list[Path]:
    """The expert's episodes, and those in which it and a policy take turns."""
    folder = tmp_path_factory.mktemp("language")
    env = make_config("panda", "pick_place")
    record(folder / "demos", env, 3, cameras=CAMERAS, language=True)
    record(folder / "mixed", env, 2, policy=checkpoint, beta=0.8, cameras=CAMERAS, language=True)
    return [folder / "demos", folder / "mixed"]


def frames(root: Path) -> list[dict[str, Any]]:
    dataset: Any = LeRobotDataset("a/b", root=root)
    return list(dataset.hf_dataset.with_format(None))


def test_every_frame_has_the_subtask_of_its_state(roots):
    for root in roots:
        dataset, env = Dataset.open(root), make_env(make_config("panda", "pick_place"))
        expert = make_expert(make_config("panda", "pick_place"))
        states = dataset.columns(["sim_state"])["sim_state"]
        for frame, vector in zip(frames(root), states, strict=True):
            state = State.from_vector(vector)
            env.set_state(state)
            text = env.subtask(expert.label(state, env).phase)
            told = [one for one in frame["language_persistent"] if one["style"] == "subtask"]
            now = [one for one in told if one["timestamp"] <= frame["timestamp"]][-1]
            assert now["content"] == text
            plans = [one for one in frame["language_persistent"] if one["style"] == "plan"]
            plan = [one for one in plans if one["timestamp"] <= frame["timestamp"]][-1]["content"]
            assert plan.startswith(f"1. {text}")


def test_lerobot_accepts_and_renders_all_of_it(roots, tmp_path):
    turns = [
        {"role": "user", "content": f"{name}: ${{{name}}}", "stream": "low_level"}
        for name in ("task", *DEFAULT_BINDINGS)
        if name != "speech"
    ]
    speech = {"role": "assistant", "tool_calls_from": "speech", "stream": "high_level"}
    target = {"role": "assistant", "content": "a", "target": True, "stream": "low_level"}
    recipe = TrainingRecipe.from_dict({"messages": [*turns, speech, target]})
    records = []
    for number, root in enumerate(roots):
        told = frames(root)
        first = [one for one in told if one["episode_index"] == 0]
        events = [
            {**row, "timestamp": frame["timestamp"]}
            for frame in first
            for row in frame["language_events"]
        ]
        EpisodeStaging(tmp_path, number).write("plan", first[0]["language_persistent"])
        EpisodeStaging(tmp_path, number).write("interjections", events)
        times = tuple(frame["timestamp"] for frame in first)
        records.append(SimpleNamespace(episode_index=number, frame_timestamps=times))
        for frame in told:
            shown = render_sample(
                recipe=recipe,
                persistent=frame["language_persistent"],
                events=frame["language_events"],
                t=frame["timestamp"],
                sample_idx=frame["index"],
            )
            assert shown is not None
            assert shown["messages"][0]["content"] != "task: "
    keys = tuple(f"observation.images.{name}" for name in CAMERAS.names)
    assert StagingValidator(dataset_camera_keys=keys).validate(records, tmp_path).errors == []
    actors = Dataset.open(roots[1]).columns(["actor", "episode_index"])
    expert, episode = actors["actor"].ravel() != Actor.LEARNER, actors["episode_index"].ravel()
    taken = np.flatnonzero(expert[1:] & ~expert[:-1] & (episode[1:] == episode[:-1])) + 1
    styles = [{row["style"] for row in frame["language_events"]} for frame in frames(roots[1])]
    assert taken.tolist() == [at for at, found in enumerate(styles) if "interjection" in found]


def test_answers_are_those_of_the_state(roots):
    asked = 0
    for root in roots:
        dataset, env = Dataset.open(root), LadderEnv(make_config("panda", "pick_place"))
        keys = [f"privileged.keypoints.{name}" for name in CAMERAS.names]
        columns = dataset.columns(["sim_state", *keys])
        places = {"green goal": 0, "cube": 1}
        for number, frame in enumerate(frames(root)):
            env.set_state(State.from_vector(columns["sim_state"][number]))
            world = env.world
            apart = np.linalg.norm(world.pose("object").position - world.ee.position)
            for row in frame["language_events"]:
                if row["style"] not in ("vqa", "trace") or row["role"] == "user":
                    continue
                asked += 1
                answer, camera = json.loads(row["content"]), row["camera"].rpartition(".")[2]
                points = columns[f"privileged.keypoints.{camera}"][number].reshape(-1, 3)
                match answer:
                    case {"point": [across, down], "label": label}:
                        x, y, seen = points[places[label]]
                        assert (across, down, seen) == (int(x * 32), int(y * 32), 1)
                    case {"points": [*path], "label": "cube"}:
                        assert len(path) > 1
                        x, y, seen = points[places["cube"]]
                        assert path[0] == [int(x * 32), int(y * 32)] or not seen
                    case {"relation": relation, "subject": one, "object": other}:
                        is_left = points[places[one], 0] < points[places[other], 0]
                        assert relation == ("left_of" if is_left else "right_of")
                    case {"attribute": "distance to the hand [cm]", "value": value}:
                        assert value == round(100 * apart)
                    case {"attribute": "state", "value": value}:
                        assert (value == "held") == world.touched("object")
                    case _:
                        assert (answer["attribute"], answer["value"]) == ("color", "red")
    assert asked > 20


def test_texts_stay_with_their_frames(roots, tmp_path):
    first, second = map(frames, roots)
    texts = ("language_persistent", "language_events")
    both = [[frame[key] for key in texts] for frame in first + second]
    assert main(["data", "merge", *map(str, roots), f"--output={tmp_path / 'both'}"]) == 0
    assert [[frame[key] for key in texts] for frame in frames(tmp_path / "both")] == both
    assert main(["data", "relabel", str(tmp_path / "both"), str(tmp_path / "again")]) == 0
    assert [[frame[key] for key in texts] for frame in frames(tmp_path / "again")] == both
    whole = LeRobotDataset("a/b", root=tmp_path / "both")
    delete_episodes(whole, [0], output_dir=tmp_path / "less", repo_id="a/c")
    left = [frame["episode_index"] > 0 for frame in first] + [True] * len(second)
    kept = [one for one, is_left in zip(both, left, strict=True) if is_left]
    assert [[frame[key] for key in texts] for frame in frames(tmp_path / "less")] == kept


@pytest.mark.parametrize(("robot", "task"), one_arm_per_task())
def test_every_task_has_words_for_each_of_its_phases(robot, task):
    world = make_env(make_config(robot, task))
    world.start(0)
    told = [world.subtask(phase) for phase in range(1, len(world.spec.phases))]
    assert all(told)
    assert not [text for text in told if "{" in text or "_" in text]
    assert world.subtask(0) == ""


def test_held_out_texts_are_other_texts_and_all_are_the_same_everywhere():
    text = "Pick up the cube and bring it to the green goal."
    trained, tested = paraphrases(text), paraphrases(text, True)
    assert trained[0] == text
    assert [len(trained), len(tested)] == [54, 18]
    assert not {*trained} & {*tested}
    assert trained[1] == "task: grab the cube and carry it to the green goal"
    assert paraphrases("The blue cube goes into the blue bin.", True)


@pytest.mark.parametrize(
    ("robot", "task", "styles"),
    [
        ("panda", "reach", {"subtask", "plan", "memory", "motion", "task_aug"}),
        ("metaworld", "reach-v3", {"task_aug"}),
    ],
)
def test_a_world_without_cameras_or_phases_goes_without(tmp_path, robot, task, styles):
    record(tmp_path / "plain", make_config(robot, task), 1)
    source = open_source(tmp_path / "plain")
    annotate_dataset(source, EditTarget(tmp_path / "told"))
    told = frames(tmp_path / "told")
    assert {one["style"] for one in told[0]["language_persistent"]} == styles
    assert not any(frame["language_events"] for frame in told)
