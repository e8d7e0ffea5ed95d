"""Rows by weight, and several datasets as one."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from manip_il.cli.main import main
from manip_il.data.lerobot_library import read_metadata
from manip_il.data.lerobot_read import read_spec, read_table, read_tables
from manip_il.errors import MismatchError
from manip_il.learn.checkpoint import CheckpointMeta
from manip_il.learn.choices import policy_config
from manip_il.learn.fit_policy import PolicyTrainer
from manip_il.learn.order import ShuffledRows, WeightedRows, order_of
from manip_il.learn.policy_config import PolicyFitConfig
from manip_il.learn.sources import JoinedFrames

from .tiny import ACT


def test_rows_are_drawn_as_often_as_they_weigh():
    weights = np.array([1.0, 0.0, 3.0, 0.0])
    order = WeightedRows(weights, 50, seed=1)
    counts = torch.bincount(torch.cat([order.batch(step) for step in range(200)]), minlength=4).numpy()
    assert counts[[1, 3]].tolist() == [0, 0]
    assert counts[2] / counts.sum() == pytest.approx(0.75, abs=5 * np.sqrt(0.75 * 0.25 / 10_000))


def test_a_weighted_batch_depends_on_seed_and_step_alone():
    weights = np.ones(100)
    assert torch.equal(WeightedRows(weights, 8, 1).batch(5), WeightedRows(weights, 8, 1).batch(5))
    assert not torch.equal(WeightedRows(weights, 8, 1).batch(5), WeightedRows(weights, 8, 1).batch(6))
    assert not torch.equal(WeightedRows(weights, 8, 1).batch(5), WeightedRows(weights, 8, 2).batch(5))


def test_without_weights_every_row_comes_once_an_epoch():
    assert isinstance(order_of(10, None, 5, 0), ShuffledRows)


@pytest.mark.parametrize("shape", [(7,), (3, 4)])
def test_joined_frames_are_those_of_the_concatenation(shape):
    rng = np.random.default_rng(0)
    pieces = [rng.integers(0, 255, (count, 3, 2, 2), dtype=np.uint8) for count in (4, 1, 6)]
    rows = rng.integers(0, 11, shape)
    np.testing.assert_array_equal(JoinedFrames(pieces)[rows], np.concatenate(pieces)[rows])


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> list[Path]:
    """Datasets of three and of two episodes."""
    folder = tmp_path_factory.mktemp("two")
    for name, count, seed in (("a", 3, 0), ("b", 2, 1)):
        words = [f"--dataset.root={folder / name}", f"--dataset.num_episodes={count}", f"--seed={seed}"]
        assert main(["record", "--task.type=reach", "--workers=1", *words]) == 0
    return [folder / "a", folder / "b"]


def trainer(roots, folder: Path, weights=None) -> PolicyTrainer:
    config = PolicyFitConfig(policy_config(ACT), steps=4, batch_size=8, save_freq=4, log_freq=2, eval_split=0.0)
    meta = CheckpointMeta.of(read_spec(roots[0]))
    return PolicyTrainer(roots, config, folder, meta, weights=weights)


def test_several_datasets_are_numbered_throughout(two):
    joined = read_tables(two, ("action", "episode_index", "index"))
    frames = len(joined["action"])
    assert np.array_equal(np.unique(joined["episode_index"]), np.arange(5))
    assert np.array_equal(joined["index"].ravel(), np.arange(frames))
    parts = [read_table(root, ("action",))["action"] for root in two]
    np.testing.assert_array_equal(joined["action"], np.concatenate(parts))


def test_several_datasets_have_the_statistics_of_all_their_frames(two):
    action = read_tables(two, ("action",))["action"].astype(np.float64)
    stats = read_metadata(*two).stats
    assert stats is not None
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(stats["action"]["std"], action.std(0), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(stats["action"]["max"], action.max(0), atol=1e-6)


def test_a_chunk_policy_learns_from_several_datasets_with_no_window_over_a_seam(two, tmp_path):
    one = trainer(two, tmp_path)
    samples = one.samples
    assert len(samples.train) == sum(len(read_table(root, ("index",))["index"]) for root in two)
    seam = len(read_table(two[0], ("index",))["index"]) - 1
    batch = next(iter(samples.source.batches([np.array([seam])])))
    assert batch["action_is_pad"][0].tolist() == [False, True, True, True]
    assert one.fit().is_dir()


def test_frames_of_no_weight_are_never_drawn(two, tmp_path):
    frames = len(read_tables(two, ("index",))["index"])
    weights = (np.arange(frames) < 20).astype(np.float64)
    one = trainer(two, tmp_path, weights)
    assert max(int(one._rows_of(step).max()) for step in range(50)) < 20


def test_datasets_of_different_robots_are_not_one(two, tmp_path):
    words = [f"--dataset.root={tmp_path / 'c'}", "--dataset.num_episodes=1", "--task.type=lift", "--workers=1"]
    assert main(["record", *words]) == 0
    with pytest.raises(MismatchError, match="tasks differs"):
        read_metadata(two[0], tmp_path / "c")
    shutil.rmtree(tmp_path / "c")
