"""Shift is seen where there is some: states elsewhere are far, those of the same kind as near as the expert's."""

import numpy as np
import pytest

from manip_il.chapter.theory.shift import relative_distance


def visited(seed: int, off: float = 0.0) -> np.ndarray:
    """States about a place, (N, d)."""
    return np.random.default_rng(seed).normal(size=(600, 5)) * [1, 2, 0.1, 1, 1] + [off, 0, 0, 0, 0]


def test_states_of_the_same_kind_are_as_near_as_the_experts_and_others_farther():
    data, fresh = visited(1), visited(2)
    assert relative_distance(visited(0), data, fresh) == pytest.approx(1, abs=0.1)
    assert relative_distance(visited(0, off=3), data, fresh) > 1.5
