"""Maximum margin: subgradients are slopes, and demonstrations win."""

import numpy as np
import pytest

from manip_il.chapter.rewards.max_margin import fit, loss_of
from manip_il.tasks.carry.grid import plan
from tests.rewards.grids import demonstrations, excess

TRUTH = np.array([1.0, 4.0, 2.0])
SIZE = {"shape": (9, 8)}


def test_the_subgradient_is_the_slope():
    [shown] = demonstrations(1, TRUTH, **SIZE)
    weights, step = np.array([1.3, 0.6, 1.1]), 1e-6
    _, gradient = loss_of(shown, weights)
    slopes = [
        (loss_of(shown, weights + move)[0] - loss_of(shown, weights - move)[0])
        for move in step * np.eye(3)
    ]
    assert gradient == pytest.approx(np.array(slopes) / (2 * step), rel=1e-5, abs=1e-5)


def test_what_is_learnt_plans_as_the_demonstrator_on_unseen_grids():
    shown = demonstrations(20, TRUTH, **SIZE)
    weights = fit(shown)
    assert excess(weights, TRUTH, **SIZE) < 0.02 < excess(np.eye(3)[0], TRUTH, **SIZE)
    for one in shown:
        assert one.sums @ weights <= 1.05 * plan(one.problem, weights).costs[one.start]
