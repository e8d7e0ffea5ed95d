"""Maximum margin: weights are those of an exact solver, and demonstrations win."""

import numpy as np
import pytest
from scipy.optimize import minimize

from manip_il.chapter.rewards.max_margin import MARGIN, RIDGE, fit, loss_of
from manip_il.tasks.carry.grid import LENGTH, Demonstration, plan
from tests.rewards.grids import acyclic, all_paths, demonstrations, excess

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


def margin(shown: Demonstration, path: np.ndarray) -> float:
    """Margin of a path of nodes over a demonstration."""
    lengths = [shown.problem.sums(path[at : at + 2])[LENGTH] for at in range(len(path) - 1)]
    return MARGIN * float(np.isin(path[1:], shown.path, invert=True) @ lengths)


def objective(shown: list[Demonstration], weights: np.ndarray) -> float:
    mean = np.mean([loss_of(one, weights)[0] for one in shown])
    return float(mean + RIDGE / 2 * weights @ weights)


@pytest.mark.parametrize("seed", range(20))
def test_weights_are_those_of_the_programme_with_a_constraint_for_every_path(seed):
    rng = np.random.default_rng(seed)
    shown, rows, margins = [], [], []
    count = int(rng.integers(1, 5))
    for at in range(count):
        problem = acyclic(rng)
        paths = all_paths(problem, 0)
        one = Demonstration(problem, paths[rng.integers(len(paths))])
        for path in paths:
            rows.append(np.append(problem.sums(path) - one.sums, np.eye(count)[at]))
            margins.append(margin(one, path))
        shown.append(one)
    exact = minimize(
        lambda x: x[3:].mean() + RIDGE / 2 * x[:3] @ x[:3],
        np.array([1.0, 0.0, 0.0, *np.full(count, 10.0)]),
        jac=lambda x: np.array([*RIDGE * x[:3], *np.full(count, 1 / count)]),
        bounds=[(1, None), (0, None), (0, None), *[(None, None)] * count],
        constraints={
            "type": "ineq",
            "fun": lambda x: np.array(rows) @ x - margins,
            "jac": lambda _: np.array(rows),
        },
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 1000},
    )
    weights, gap = fit(shown)
    assert gap <= 1e-9
    assert objective(shown, weights) == pytest.approx(exact.fun, rel=1e-6)
    assert weights == pytest.approx(exact.x[:3], abs=1e-6)


def test_what_is_learnt_plans_as_the_demonstrator_on_unseen_grids():
    shown = demonstrations(20, TRUTH, **SIZE)
    weights, _ = fit(shown)
    assert excess(weights, TRUTH, **SIZE) < 0.02 < excess(np.eye(3)[0], TRUTH, **SIZE)
    for one in shown:
        assert one.sums @ weights <= 1.05 * plan(one.problem, weights).costs[one.start]
