"""Shift is seen where there is some: states elsewhere are far and told apart, those of the same kind are not."""

import numpy as np
import pytest

from manip_il.theory.shift import Visited, _apart, _told_apart  # pyright: ignore[reportPrivateUsage]


def visited(seed: int, off: float = 0.0, episodes: int = 20, length: int = 30) -> Visited:
    """States about a place, in episodes."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(episodes * length, 5)) * [1, 2, 0.1, 1, 1] + [off, 0, 0, 0, 0]
    return Visited(rows, rows[:, :3], np.repeat(np.arange(episodes), length))


def test_states_of_the_same_kind_are_as_near_as_the_experts_and_not_told_apart():
    own, data, fresh = visited(0), visited(1), visited(2)
    assert _apart(own.observed, data.observed, fresh.observed) == pytest.approx(1, abs=0.1)
    assert _told_apart(own, data) == pytest.approx(0.5, abs=0.06)


def test_states_elsewhere_are_farther_and_told_apart():
    own, data, fresh = visited(0, off=3), visited(1), visited(2)
    assert _apart(own.observed, data.observed, fresh.observed) > 1.5
    assert _told_apart(own, data) > 0.9


def test_a_column_that_does_not_change_is_no_distance():
    own, data, fresh = (visited(seed) for seed in range(3))
    still = [np.hstack([one.observed, np.ones((len(one.observed), 1))]) for one in (own, data, fresh)]
    assert _apart(*still) == _apart(own.observed, data.observed, fresh.observed)
