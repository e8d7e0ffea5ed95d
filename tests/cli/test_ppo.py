"""`manip-il rl ppo`: a clone goes on from a reward learnt from preferences, of the same robot
and task.
"""

import json
from pathlib import Path

import pytest
import torch

from manip_il.chapter.reward import RewardNetwork, RewardShape, ways_of, write_reward
from manip_il.cli.main import main
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_spec, make_config

from ..collect.clones import clone

ENV = make_config("fetch", "reach")


def reward(folder: Path, env: EnvConfig = ENV) -> Path:
    """A reward for an environment, whose weights nobody has learnt."""
    spec = env_spec(env)
    shape = RewardShape(members=3, width=4, ways=ways_of(spec))
    torch.manual_seed(0)
    width = 2 * len(spec.joint_names) + len(spec.environment_state_names)
    folder.mkdir(parents=True)
    write_reward(folder, RewardNetwork(width, shape), spec, {}, {})
    return folder


@pytest.fixture(scope="module")
def cloned(tmp_path_factory) -> Path:
    return clone(ENV, 2, tmp_path_factory.mktemp("cloned"), steps=5, width=16)


@pytest.mark.slow
def test_a_run_ends_with_a_policy_metrics_and_a_page(here, cloned, capsys):
    reward(here / "reward")
    small = "--steps=1 --episodes=2 --episode_steps=4 --warmup=0 --ppo.minibatches=1 --ppo.epochs=1"
    words = [
        *f"rl ppo --init={cloned} --reward=reward".split(),
        *small.split(),
        "--validation_episodes=1",
    ]
    assert main([*words, "--output_dir=run", "--quiet"]) == 0
    assert "manip-il eval --policy.path=run" in capsys.readouterr().out
    start, record = map(json.loads, (here / "run" / "metrics.jsonl").read_text().splitlines())
    assert (start["iteration"], start["steps"], start["validation_episodes"]) == (
        0,
        0,
        1,
    ), "the clone itself"
    assert record["steps"] == 8, "episodes go on after success"
    assert (here / "run" / "best" / "pretrained_model" / "model.safetensors").is_file()
    assert "PPO on" in (here / "run" / "report.html").read_text()
