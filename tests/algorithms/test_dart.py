"""DART's noise is the learner's own error, dimension by dimension and together."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from manip_il.algorithms import dart
from manip_il.data.dataset import Dataset
from manip_il.learn.policy import LearnedPolicy


class Wrong:
    """Acts as the expert's label says, plus an error that it was given for every frame."""

    def __init__(self, table: dict[str, np.ndarray], errors: np.ndarray):
        self.actions = table["action"] + errors
        self.states = table["observation.state"]
        self.episodes: list[list[int]] = []

    def begin(self, instructions):
        assert set(instructions.values()) == {"Push."}

    def act(self, states, environment_states, images, episodes):
        self.episodes.append(list(episodes))
        rows = [int(np.flatnonzero((self.states == state).all(axis=1))[0]) for state in states]
        return self.actions[rows]


@pytest.fixture
def table() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {
        "observation.state": rng.normal(size=(6, 2)).astype(np.float32),
        "observation.environment_state": np.zeros((6, 1), np.float32),
        "action": rng.normal(size=(6, 2)).astype(np.float32),
        "label_valid": np.array([1, 1, 0, 1, 1, 1]),
        "episode_index": np.array([0, 0, 0, 0, 1, 1]),
    }


def noise(table, errors, monkeypatch) -> tuple[np.ndarray, Wrong]:
    policy = Wrong(table, errors)
    index = np.unique(table["episode_index"])
    episodes = SimpleNamespace(index=index, tasks=[["Push."]] * len(index))
    dataset = SimpleNamespace(columns=lambda names: table, episodes=episodes)
    monkeypatch.setattr(Dataset, "open", lambda root: dataset)
    monkeypatch.setattr(LearnedPolicy, "load", lambda path, *, trust: policy)
    return np.array(dart.fitted_noise(Path("p"), Path("d"))), policy


def test_noise_is_the_mean_outer_product_of_the_errors_where_labels_are_sound(table, monkeypatch):
    errors = np.random.default_rng(4).normal(size=(6, 2))
    fitted, _ = noise(table, errors, monkeypatch)
    sound = errors[table["label_valid"] != 0]
    expected = sum(np.outer(error, error) for error in sound) / len(sound)
    np.testing.assert_allclose(fitted, expected, atol=1e-6)


def test_a_policy_is_episodes_in_the_order_of_time(table, monkeypatch):
    _, policy = noise(table, np.zeros((6, 2)), monkeypatch)
    assert policy.episodes == [[0, 1], [0, 1], [0], [0]]
