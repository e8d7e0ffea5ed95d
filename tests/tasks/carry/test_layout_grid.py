"""The grid of `carry`: costs are those of paths, paths keep off obstacles, their features are
line integrals.
"""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.robots.reach import reach_of
from manip_il.robots.table import get_robot
from manip_il.tasks.carry.grid import Grid, descent, plan
from manip_il.tasks.carry.layout import FEATURES, TASTES, Edge, Layout, Part

from ...tables import every_robot
from .features import path_features

PARTS = (Part(-0.025, 0.036), Part(-0.018, 0.072), Part(0.07, 0.105), Part(0.19, 0.139))
LAYOUT = Layout(
    scale=1.0,
    goal=(0.55, 0.12, 0.06),
    places=(("vase", (0.42, 0.0)), ("laptop", (0.50, -0.10)), ("candle", (0.36, 0.19))),
    edge=Edge((0.62, 0.0), (1.0, 0.0)),
    half=0.025,
    parts=PARTS,
)
ROBOT = get_robot("panda")
STARTS = np.array([[0.35, -0.13, 0.07], [0.58, -0.12, 0.09], [0.45, 0.0, 0.25], [0.3, 0.1, 0.2]])
CAREFUL = TASTES["careful"]


@cache
def grid() -> Grid:
    return Grid(LAYOUT, ROBOT)


def node_near(position: np.ndarray) -> int:
    nodes = grid().near(position)
    return int(nodes[np.argmin(np.linalg.norm(grid().points[nodes] - position, axis=1))])


def weights_with(**weights: float) -> np.ndarray:
    return np.array([{"length": 1.0, **weights}.get(name, 0.0) for name in FEATURES])


@pytest.mark.parametrize("taste", TASTES)
def test_costs_to_go_are_the_cheapest_paths_features_times_the_weights(taste: str):
    weights, problem = np.array(TASTES[taste].weights), grid().problem
    costs, planned = grid().costs_to_go(weights), plan(problem, weights)
    np.testing.assert_allclose(costs, planned.costs, rtol=1e-9)
    for start in STARTS:
        path, features = planned.path(node_near(start))
        assert features @ weights == pytest.approx(costs[path[0]], rel=1e-9)


def test_an_edges_features_are_the_line_integrals_of_any_path():
    for start in STARTS:
        path, features = plan(grid().problem, np.array(CAREFUL.weights)).path(node_near(start))
        along = path_features(LAYOUT, grid().points[path])
        np.testing.assert_allclose(features, along, rtol=0.01, atol=5e-4)
        assert features[0] == pytest.approx(along[0], rel=1e-12)


@pytest.mark.parametrize(
    "name", ["above_laptop", "near_vase", "near_candle", "near_edge", "height"]
)
def test_a_heavier_weight_keeps_planned_paths_no_nearer(name: str):
    at, found = FEATURES.index(name), []
    for weight in (0.0, 0.5, 2.0, 8.0, 30.0):
        planned = plan(grid().problem, weights_with(**{name: weight}))
        found.append([planned.path(node_near(start))[1][at] for start in STARTS])
    assert (np.diff(found, axis=0) <= 1e-9).all()
    assert (np.array(found[-1]) < found[0]).any()


@given(st.integers(0, 2**32 - 1))
def test_the_descent_leads_to_the_goal_past_all_obstacles(seed: int):
    down, rng = descent(LAYOUT, CAREFUL, ROBOT), np.random.default_rng(seed)
    position = grid().points[rng.choice(np.flatnonzero(grid().free))] + rng.uniform(-0.01, 0.01, 3)
    cost, heading = down.look(position)
    room, costs = LAYOUT.room(position[None])[0], [cost]
    for _ in range(400):
        if heading is None or math.dist(position, LAYOUT.goal) < 0.005:
            break
        way = heading - position
        position = position + way * min(1.0, 0.01 / np.linalg.norm(way))
        assert LAYOUT.room(position[None])[0] > min(room, 0.0) - 0.006
        cost, heading = down.look(position)
        costs.append(cost)
    assert math.dist(position, LAYOUT.goal) < 0.005
    assert np.diff(costs).max(initial=0.0) < 0.02 * costs[0] + 0.01
    assert costs[-1] < 0.05


@every_robot
def test_the_grid_takes_the_map_of_where_the_hand_gets_to(robot: str):
    arm, reach = get_robot(robot), reach_of(get_robot(robot))
    points = np.array([*arm.workspace.centre, 0.1]) + np.random.default_rng(0).uniform(
        -0.4, 0.4, (500, 3)
    ) * [
        1,
        1,
        0.5,
    ]
    assert reach.has_each(points).tolist() == [reach.has(point) for point in points]
    assert 0 < reach.has_each(points).sum() < len(points)
