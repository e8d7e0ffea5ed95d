from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from manip_il.errors import ManipError, UsageError
from manip_il.learn.windows import Windows, windows_of

EPISODES = np.repeat([0, 1, 2], [5, 2, 4])


@given(st.lists(st.integers(1, 6), min_size=1, max_size=5), st.lists(st.integers(-4, 4), min_size=1, max_size=6))
def test_a_window_never_leaves_its_episode(lengths, deltas) -> None:
    episodes = np.repeat(np.arange(len(lengths)), lengths)
    samples = np.arange(len(episodes))
    rows, padded = Windows(episodes, {"action": np.array(deltas)}).rows(samples, "action")
    assert (episodes[rows] == episodes[:, None]).all()
    wanted = samples[:, None] + np.array(deltas)
    assert (rows[~padded] == wanted[~padded]).all()
    outside = (
        (wanted < 0)
        | (wanted >= len(episodes))
        | (episodes[np.clip(wanted, 0, len(episodes) - 1)] != episodes[:, None])
    )
    assert (padded == outside).all()


def test_a_frame_outside_is_the_nearest_one_inside() -> None:
    rows, padded = Windows(EPISODES, {"action": np.array([-1, 0, 1, 2])}).rows(np.array([0, 4, 5]), "action")
    assert rows.tolist() == [[0, 0, 1, 2], [3, 4, 4, 4], [5, 5, 6, 6]]
    assert padded.tolist() == [[True, False, False, False], [False, False, True, True], [True, False, False, True]]


def test_a_window_with_an_unsound_label_is_left_out() -> None:
    valid = np.ones(11, dtype=bool)
    valid[3] = False
    usable = Windows(EPISODES, {"action": np.arange(3)}).usable(valid)
    assert usable.tolist() == [0, 4, 5, 6, 7, 8, 9, 10]  # 1, 2 and 3 would learn from frame 3


def test_the_last_frames_of_an_episode_can_be_left_out() -> None:
    usable = Windows(EPISODES, {}).usable(np.ones(11, dtype=bool), drop_last=1)
    assert usable.tolist() == [0, 1, 2, 3, 5, 7, 8, 9]


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
