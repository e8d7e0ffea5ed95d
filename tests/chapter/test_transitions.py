"""Demonstrations as episodes of one length: what is padded, what is left out, what is refused."""

from pathlib import Path

import numpy as np

from manip_il.chapter import episodes
from manip_il.chapter.episodes import Demonstrations, read_demonstrations
from manip_il.mdp import Actor

from ..learn.conftest import EPISODES, LENGTH, make_table
from .point import network


def two() -> Demonstrations:
    inputs = tuple(np.full((length, 3), length, np.float32) for length in (4, 6))
    targets = tuple(np.full((length, 2), length, np.float32) for length in (4, 6))
    return Demonstrations(inputs, targets, hold=2)


def test_a_demonstration_goes_on_in_the_absorbing_state_until_the_last_step():
    rows = two().padded(8, network((0.5, 0.5), (5, 5)))
    assert len(rows) == 16
    assert rows.absorbing.tolist() == [False] * 4 + [True] * 4 + [False] * 6 + [True] * 2
    assert rows.actions[0].tolist() == [8, 8]
    assert rows.actions[8].tolist() == [10, 10], "targets stay within the policy's range"
    assert not rows.actions[rows.absorbing].any()
    assert rows.next_states[3].tolist() == [0, 0, 0, 1]


def test_a_demonstration_that_fills_the_episode_still_ends_in_the_absorbing_state():
    rows = two().padded(6, network((0.5, 0.5), (5, 5)))
    assert len(rows) == 12
    assert rows.next_states[-1].tolist() == [0, 0, 0, 1]


def test_only_whole_successful_episodes_of_the_expert_with_labels_are_read(monkeypatch):
    table = make_table()
    table["label_valid"] = np.ones(EPISODES * LENGTH, np.int64)
    table["actor"] = np.full(EPISODES * LENGTH, Actor.EXPERT)
    table["next.success"] = np.tile(np.arange(LENGTH) >= LENGTH - 5, EPISODES)
    table["actor"][0] = Actor.LEARNER
    table["next.success"][LENGTH : 2 * LENGTH] = False
    table["label_valid"][2 * LENGTH] = 0
    monkeypatch.setattr(episodes, "joined_columns", lambda roots, names: table)
    found = read_demonstrations([Path("demos")], lambda actions, states: actions - states)
    assert (len(found.inputs), found.longest, found.hold) == (EPISODES - 3, LENGTH, 4)
    assert found.inputs[0].shape == (LENGTH, 10)
