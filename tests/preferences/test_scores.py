"""Scores of episodes, weights of frames, and that LeRobot takes them as its own."""

import json
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.rewards.sarm.rabc import RABCWeights

from manip_il.chapter.preferences.pairs import Frames, read_frames
from manip_il.chapter.preferences.scores import Scores, write_weights
from manip_il.learn.samples import rabc_weights


@pytest.fixture(scope="module")
def scored(datasets) -> Scores:
    """Both datasets as one, scored by true progress with a little noise."""
    good, bad = (read_frames(datasets / name) for name in ("good", "bad"))
    columns = ("inputs", "progress", "success")
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in (good, bad)]) for name in columns
    }
    data = Frames(good.spec, episodes=np.concatenate([good.episodes, bad.episodes + 8]), **joined)
    noise = np.random.default_rng(0).normal(size=len(data.inputs)) * 0.02
    return Scores("both", "a test", data, np.clip(joined["progress"] + noise, 0, 1))


def test_failed_episodes_are_found_and_listed_first(scored):
    assert not scored.succeeded[np.argsort(scored.episodes)[:8]].any()
    tree = scored.to_json()
    assert [one["success"] for one in tree["episodes"]] == [True] * 8 + [False] * 8
    assert json.loads(json.dumps(tree)) == tree


@pytest.mark.parametrize("ahead", [1, 7, 100])
def test_weights_are_lerobots(ahead, scored, tmp_path):
    path = tmp_path / "rabc.parquet"
    write_weights(path, scored)
    theirs = RABCWeights(path, chunk_size=ahead, device=torch.device("cpu"))
    deltas = np.array(
        [theirs._compute_delta(index) for index in range(len(scored.frames))], np.float32
    )
    ours = rabc_weights(path, scored.data.episodes, ahead)
    assert ours == pytest.approx(theirs._compute_weights(deltas), abs=1e-5)
    assert {0.0, 1.0} < set(ours.tolist())


def test_frames_weigh_by_how_their_episode_ends(scored, tmp_path):
    """But for an episode's last frame, after which nothing rises or falls."""
    path, data = tmp_path / "rabc.parquet", scored.data
    write_weights(path, scored)
    weights = rabc_weights(path, data.episodes, 5)
    inner = np.delete(np.arange(len(weights)), data.firsts + data.lengths - 1)
    assert (weights[inner] == scored.succeeded.repeat(data.lengths)[inner]).all()
    assert pq.read_table(path)["score"].to_numpy() == pytest.approx(scored.frames, abs=1e-6)
    assert [one["kept"] for one in scored.to_json()["episodes"]] == [True] * 8 + [False] * 8
