"""The environment as LeRobot's code sees it."""

import sys
from typing import Any

import pytest
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

from manip_il.errors import UnknownName, UsageError
from manip_il.lerobot_plugin import ManipILEnv
from manip_il.lerobot_plugin.environment import TASKS
from manip_il.worlds.table import make_config

from ..tables import BEYOND

STATE, PICTURE = "observation.state", "observation.images.wrist"
POSES = "observation.environment_state"


def shapes(config: ManipILEnv) -> dict[str, tuple[int, ...]]:
    return {key: feature.shape for key, feature in env_to_policy_features(config).items()}


def vector_env(config: ManipILEnv, count: int) -> Any:
    return config.create_envs(count)["manip_il"][0]


@pytest.mark.parametrize(
    ("observation", "inputs"),
    [
        ("state", {STATE: (8,), POSES: (25,)}),
        ("images", {STATE: (8,), PICTURE: (3, 32, 48)}),
        ("both", {STATE: (8,), POSES: (25,), PICTURE: (3, 32, 48)}),
    ],
)
def test_a_policys_inputs_are_those_of_the_chosen_observation(
    observation: str, inputs: dict[str, tuple[int, ...]]
):
    config = ManipILEnv(
        observation=observation, cameras="wrist", observation_height=32, observation_width=48
    )
    assert shapes(config) == inputs | {"action": (8,)}


@pytest.mark.parametrize("task", [name for name, names in TASKS.items() if names not in BEYOND])
def test_every_task_gives_what_its_features_say(task: str):
    config, ours = ManipILEnv(task=task), make_config(*TASKS[task])
    envs = vector_env(config, 2)
    observation, _ = envs.reset(seed=[1, 2])
    seen = preprocess_observation(observation)
    given = {key: tuple(value.shape[1:]) for key, value in seen.items()}
    assert given | {"action": envs.single_action_space.shape} == shapes(config)
    assert envs.call("task_description")[0]
    assert envs.call("_max_episode_steps") == (ours.horizon,) * 2
    assert envs.metadata["render_fps"] == config.fps == ours.control_hz


def test_success_in_the_step_that_ends_an_episode_is_told_although_the_next_one_has_begun():
    config = ManipILEnv(task="PandaReach-v0", episode_length=2, tolerance=0.99, success_steps=2)
    envs = vector_env(config, 2)
    observation, _ = envs.reset(seed=[1, 2])
    *_, first = envs.step(observation["agent_pos"])
    *_, truncated, last = envs.step(observation["agent_pos"])
    assert "final_info" not in first
    assert truncated.all()
    assert last["final_info"]["is_success"].tolist() == [True, True]
    assert not last["is_success"].any()


def test_a_file_is_opened_only_if_the_command_line_names_it(tmp_path, monkeypatch):
    own = tmp_path / "own.py"
    own.write_text("from pathlib import Path\nPath(__file__).with_name('ran').touch()\n")
    with pytest.raises(UnknownName, match=r"own\.py"):  # as from a checkpoint's `train_config.json`
        ManipILEnv(task=str(own))
    assert [one.name for one in tmp_path.iterdir()] == ["own.py"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--env.task={own}"])
    with pytest.raises(UsageError, match=r"own\.py: none; expected one subclass"):
        ManipILEnv(task=str(own))
    assert (tmp_path / "ran").is_file()
