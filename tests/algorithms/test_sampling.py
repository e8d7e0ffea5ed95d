"""How often each kind of frame is learnt from."""

from __future__ import annotations

import numpy as np
import pytest

from manip_il.algorithms.config import Sampling
from manip_il.algorithms.rounds import frame_weights
from manip_il.errors import UsageError
from manip_il.mdp import Actor

SCALE = np.array([0.2, 0.08])


@pytest.fixture
def table() -> dict[str, np.ndarray]:
    """Demonstration; learner right, wrong by joint, wrong by gripper; the expert's recovery."""
    executed = np.array([[0.0, 0.0], [0.04, 0.0], [0.06, 0.0], [0.0, 0.03], [0.0, 0.0]], np.float32)
    return {
        "round": np.array([0, 1, 1, 2, 2]),
        "actor": np.array([Actor.EXPERT, *[Actor.LEARNER] * 3, Actor.EXPERT]),
        "executed_action": executed,
        "action": np.zeros_like(executed),
    }


def test_frames_weigh_what_their_kind_does(table):
    weights = frame_weights(Sampling(demonstrations=1, corrections=3, rollouts=0.5), table, SCALE)
    assert weights.tolist() == [1, 0.5, 3, 3, 3]


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"corrections": -1}, "sampling.corrections is -1"),
        ({"demonstrations": 0}, "nothing else to learn from"),
    ],
)
def test_weights_that_make_no_sense_are_refused(values, says: str):
    with pytest.raises(UsageError, match=says):
        Sampling(**values)
