"""Targets of preferences: pairs, answers, a reward's folder, and the file that weighs frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from manip_il.collect.environments import env_spec
from manip_il.learn.preference.modeling_preference import write_reward
from manip_il.learn.preference.network import RewardNetwork, RewardShape, joints_of, ways_of
from manip_il.learn.reward import LearnedReward
from manip_il.learn.weights import rabc_weights, read_progress
from manip_il.preferences.answers import Answer, Preferences, join_answers
from manip_il.preferences.pairs import Clip, Pairs, Source

from ..cli.made_runs import ENV
from .binary import mutate_parquet, mutate_safetensors
from .target import Target
from .trees import mutate_json

EPISODES = np.repeat(np.arange(3), 5)


def make_pairs(folder: Path) -> None:
    """`pairs.json` and `preferences.json` about them."""
    clips = [Clip(source, episode, 3 * episode) for source in range(2) for episode in range(4)]
    sources = tuple(Source(f"datasets/{name}", "0" * 64, 4, 400) for name in "ab")
    pairs = Pairs("panda", "reach", 20, 10, sources, tuple(zip(clips[:4], clips[4:], strict=True)))
    given = tuple(Answer(number, one, "2026-01-31T12:00:00Z") for number, one in enumerate(("left", "equal", "skip")))
    (folder / "pairs.json").write_text(json.dumps(pairs.to_json()))
    (folder / "preferences.json").write_text(json.dumps(Preferences(pairs.sha256, "Ada", given).to_json()))


def _read_pairs(folder: Path) -> None:
    Pairs.read(folder / "pairs.json")


def _read_answers(folder: Path) -> None:
    join_answers([Preferences.read(folder / "preferences.json", [Pairs.read(folder / "pairs.json")])])


def make_reward(folder: Path) -> None:
    """`reward`: three small networks of random weights."""
    spec = env_spec(ENV)
    shape = RewardShape(3, 4, ways=ways_of(spec), unread=joints_of(spec), logarithms=True)
    network = RewardNetwork(2 * len(spec.joint_names) + len(spec.environment_state_names), shape)
    network.initialise(torch.Generator().manual_seed(0))
    write_reward(folder / "reward", network, shape, spec, {}, {})


def _use_reward(folder: Path) -> None:
    spec, reward = env_spec(ENV), LearnedReward.load(folder / "reward")
    reward.check_fits("the dataset", spec)
    n, k = len(spec.joint_names), len(spec.environment_state_names)
    reward(*(np.zeros((2, width), np.float32) for width in (n, k, n)))


def make_weights(folder: Path) -> None:
    """`rabc.parquet`: three episodes of five frames."""
    rows = np.arange(len(EPISODES))
    columns = {"index": rows, "episode_index": EPISODES, "frame_index": rows % 5, "progress_sparse": rows / len(rows)}
    pq.write_table(pa.table(columns), folder / "rabc.parquet")


def _weigh(folder: Path) -> None:
    rabc_weights(read_progress(folder / "rabc.parquet", EPISODES), EPISODES, 2)


TARGETS = (
    Target("pairs.json", make_pairs, "pairs.json", mutate_json, (_read_pairs,)),
    Target("preferences.json", make_pairs, "preferences.json", mutate_json, (_read_answers,)),
    Target("reward config.json", make_reward, "reward/config.json", mutate_json, (_use_reward,)),
    Target("reward manip_il.json", make_reward, "reward/manip_il.json", mutate_json, (_use_reward,)),
    Target("reward weights", make_reward, "reward/model.safetensors", mutate_safetensors, (_use_reward,)),
    Target("rabc.parquet", make_weights, "rabc.parquet", mutate_parquet, (_weigh,)),
)
