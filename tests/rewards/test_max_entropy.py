"""Maximum entropy: its gradient is the likelihood's, and its solution has the demonstrations'
features.
"""

import numpy as np
import pytest

from manip_il.chapter.inverse import learn
from manip_il.chapter.rewards.max_entropy import fit, least_weights, loss_of, soft_plan
from manip_il.tasks.carry.grid import LENGTH, Demonstration
from tests.rewards.grids import draw, grid

WEIGHTS = np.array([3.5, 2.0, 5.0])


def demonstrations(count: int, weights: np.ndarray = WEIGHTS, seed: int = 0) -> list[Demonstration]:
    """Paths drawn from the distribution of the weights, each in a world of its own."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        problem = grid(rng)
        found.append(
            Demonstration(problem, draw(soft_plan(problem, weights), int(rng.integers(20)), rng))
        )
    return found


@pytest.mark.parametrize("prior", [1.0, 100.0])
def test_the_gradient_is_that_of_central_differences(prior):
    shown, rng = demonstrations(5), np.random.default_rng(1)
    for _ in range(3):
        weights = WEIGHTS * rng.uniform(0.8, 1.5, 3)
        _, gradient = loss_of(shown, weights, prior)
        step = 1e-4
        differences = [
            (loss_of(shown, weights + move, prior)[0] - loss_of(shown, weights - move, prior)[0])
            / (2 * step)
            for move in step * np.eye(3)
        ]
        assert np.abs(gradient - differences).max() / np.abs(gradient).max() <= 1e-6


def test_weights_are_those_that_drew_the_demonstrations():
    assert fit(demonstrations(300)) == pytest.approx(WEIGHTS, abs=0.8)


def winding(rng: np.random.Generator) -> Demonstration:
    """A path through every node of a grid, row by row, there and back."""
    nodes = np.arange(30).reshape(6, 5)
    nodes[1::2] = nodes[1::2, ::-1]
    path = nodes.ravel()
    return Demonstration(grid(rng), path[: 1 + int(np.flatnonzero(path == 29)[0])])


def test_weights_at_their_lower_bounds_are_named_and_warned_of(caplog):
    rng = np.random.default_rng(0)
    long_ways = [winding(rng) for _ in range(4)]
    with caplog.at_level("WARNING", "manip_il"):
        learn("max_entropy", demonstrations(20), rng)
        assert caplog.messages == []
        learn("max_entropy", long_ways, rng)
    [line] = caplog.messages
    assert f"length ({least_weights(long_ways)[LENGTH]:.0f} / m)" in line
