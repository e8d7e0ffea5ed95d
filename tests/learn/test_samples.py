"""Samples are windows of one episode, of one dataset or of several."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from manip_il.cli.main import main
from manip_il.data.dataset import Dataset, joined_columns
from manip_il.data.lerobot_library import read_metadata
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.fit_policy import PolicyTrainer
from manip_il.learn.samples import JoinedFrames, Windows, windows_of

from .tiny_policies import ACT

EPISODES = np.repeat([0, 1, 2], [5, 2, 4])


@given(st.lists(st.integers(1, 6), min_size=1, max_size=5), st.lists(st.integers(-4, 4), min_size=1, max_size=6))
def test_a_window_never_leaves_its_episode(lengths, deltas) -> None:
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    samples = np.arange(len(episodes))
    rows, padded = Windows(episodes, {"action": np.array(deltas)}).rows(samples, "action")
    assert (episodes[rows] == episodes[:, None]).all()
    wanted = samples[:, None] + np.array(deltas)
    assert (rows[~padded] == wanted[~padded]).all()
    around = np.pad(episodes, 4, constant_values=-1)  # of what lies beyond all episodes
    assert (padded == (around[wanted + 4] != episodes[:, None])).all()


def test_a_frame_outside_is_the_nearest_one_inside() -> None:
    rows, padded = Windows(EPISODES, {"action": np.array([-1, 0, 1, 2])}).rows(np.array([0, 4, 5]), "action")
    assert rows.tolist() == [[0, 0, 1, 2], [3, 4, 4, 4], [5, 5, 6, 6]]
    assert padded.tolist() == [[True, False, False, False], [False, False, True, True], [True, False, False, True]]


@pytest.mark.parametrize(
    ("deltas", "invalid", "drop_last", "usable"),
    [
        ({"action": np.arange(3)}, [3], 0, [0, 4, 5, 6, 7, 8, 9, 10]),  # 1, 2 and 3 would learn from frame 3
        ({}, [], 1, [0, 1, 2, 3, 5, 7, 8, 9]),
    ],
    ids=["unsound label", "last frames"],
)
def test_samples_with_an_unsound_label_and_last_frames_are_left_out(deltas, invalid, drop_last, usable) -> None:
    valid = ~np.isin(np.arange(11), invalid)
    assert Windows(EPISODES, deltas).usable(valid, drop_last).tolist() == usable


def test_nothing_left_to_learn_from_is_an_error() -> None:
    with pytest.raises(ManipError, match="nothing to learn from"):
        Windows(EPISODES, {}).usable(np.zeros(11, dtype=bool))


def test_the_windows_are_those_that_the_policy_asks_for() -> None:
    columns = ["observation.state", "action"]
    act = windows_of(ACTConfig(chunk_size=4, n_action_steps=4, device="cpu"), columns, EPISODES)
    assert {key: value.tolist() for key, value in act.deltas.items()} == {"action": [0, 1, 2, 3]}
    diffusion = windows_of(DiffusionConfig(n_obs_steps=2, horizon=8, device="cpu"), columns, EPISODES)
    assert diffusion.deltas["observation.state"].tolist() == [-1, 0]
    assert diffusion.deltas["action"].tolist() == list(range(-1, 7))


def test_a_dataset_shorter_than_one_chunk_is_named() -> None:
    with pytest.raises(UsageError, match=r"11 frames, fewer than one chunk of 12 actions"):
        windows_of(ACTConfig(chunk_size=12, n_action_steps=4, device="cpu"), ["action"], EPISODES)


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
    config = FitConfig(ACT, steps=4, batch_size=8, save_freq=4, log_freq=2, eval_split=0.0)
    return PolicyTrainer(roots, config, folder, spec=Dataset.open(roots[0]).spec, weights=weights)


def test_several_datasets_are_numbered_throughout_and_have_the_statistics_of_all_frames(two):
    joined = joined_columns(two, ("action", "episode_index", "index"))
    action = joined["action"].astype(np.float64)
    assert np.array_equal(np.unique(joined["episode_index"]), np.arange(5))
    assert np.array_equal(joined["index"].ravel(), np.arange(len(action)))
    np.testing.assert_array_equal(
        action, np.concatenate([Dataset.open(root).columns(("action",))["action"] for root in two])
    )
    stats = read_metadata(*two).stats
    assert stats is not None
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(stats["action"]["std"], action.std(0), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(stats["action"]["max"], action.max(0), atol=1e-6)


def test_a_chunk_policy_learns_from_several_datasets_with_no_window_over_a_seam(two, tmp_path):
    one = trainer(two, tmp_path)
    samples = one.samples
    assert len(samples.train) == sum(len(Dataset.open(root).columns(("index",))["index"]) for root in two)
    seam = len(Dataset.open(two[0]).columns(("index",))["index"]) - 1
    batch = next(iter(samples.source.batches([np.array([seam])])))
    assert batch["action_is_pad"][0].tolist() == [False, True, True, True]
    assert one.fit().is_dir()


def test_frames_of_no_weight_are_never_drawn(two, tmp_path):
    frames = len(joined_columns(two, ("index",))["index"])
    weights = (np.arange(frames) < 20).astype(np.float64)
    one = trainer(two, tmp_path, weights)
    assert max(int(one._rows_of(step).max()) for step in range(50)) < 20


def test_datasets_of_different_robots_are_not_one(two, tmp_path):
    words = [f"--dataset.root={tmp_path / 'c'}", "--dataset.num_episodes=1", "--task.type=lift", "--workers=1"]
    assert main(["record", *words]) == 0
    with pytest.raises(MismatchError, match="environment_state differs: "):
        read_metadata(two[0], tmp_path / "c")
