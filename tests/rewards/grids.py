"""Small worlds for inverse reinforcement learning: grids with things on them, and demonstrations
of a known taste.
"""

import numpy as np

from manip_il.chapter.rewards.max_entropy import SoftPlan
from manip_il.tasks.carry.grid import Demonstration, PathProblem, plan


def grid(rng: np.random.Generator, shape: tuple[int, int] = (6, 5), things: int = 2) -> PathProblem:
    """A grid with neighbours in all directions: length, then what each of some things, at drawn
    places, adds near it.

    The goal is the last node.
    """
    places = np.argwhere(np.ones(shape))
    edges = np.argwhere(np.abs(places[:, None] - places).max(axis=-1) == 1)
    length = np.linalg.norm(places[edges[:, 0]] - places[edges[:, 1]], axis=1)
    things_at = rng.uniform(0, np.array(shape) - 1, (things, 2))
    near = [np.exp(-0.5 * ((places - at) ** 2).sum(axis=1)) for at in things_at]
    features = [length, *(length * one[edges].mean(axis=1) for one in near)]
    return PathProblem(edges, np.stack(features, axis=1), len(places), len(places) - 1)


def acyclic(
    rng: np.random.Generator, nodes: int = 7, features: int = 3, share: float = 0.6
) -> PathProblem:
    """A random graph without circles: edges lead to higher numbers, one chain through all.

    The last is the goal.
    """
    pairs = [
        (i, j)
        for i in range(nodes)
        for j in range(i + 1, nodes)
        if j == i + 1 or rng.random() < share
    ]
    return PathProblem(np.array(pairs), rng.random((len(pairs), features)), nodes, nodes - 1)


def all_paths(problem: PathProblem, start: int) -> list[np.ndarray]:
    """Every path (n,) from a start to the goal of a problem without circles."""
    found, unfinished = [], [[start]]
    while unfinished:
        path = unfinished.pop()
        if path[-1] == problem.goal:
            found.append(np.array(path, np.int64))
        else:
            unfinished += [
                [*path, int(to)] for to in problem.edges[problem.edges[:, 0] == path[-1], 1]
            ]
    return found


def draw(planned: SoftPlan, start: int, rng: np.random.Generator) -> np.ndarray:
    """Nodes (n,) of a path drawn from the distribution."""
    problem, path = planned.problem, [start]
    while path[-1] != problem.goal:
        edges = np.flatnonzero(problem.edges[:, 0] == path[-1])
        path.append(int(problem.edges[rng.choice(edges, p=planned.chances[edges]), 1]))
    return np.array(path)


def demonstrations(count: int, weights: np.ndarray, seed: int = 0, **kwargs) -> list[Demonstration]:
    """Cheapest paths for weights, each through a grid of its own."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        problem = grid(rng, **kwargs)
        start = int(rng.integers(problem.nodes // 2))
        found.append(Demonstration(problem, plan(problem, weights).path(start)[0]))
    return found


def excess(weights: np.ndarray, truth: np.ndarray, seed: int = 1, **kwargs) -> float:
    """What paths planned with weights cost for the true ones, above the least, on unseen grids."""
    rng, paid, least = np.random.default_rng(seed), 0.0, 0.0
    for _ in range(40):
        problem = grid(rng, **kwargs)
        start = int(rng.integers(problem.nodes // 2))
        paid += plan(problem, weights).path(start)[1] @ truth
        least += plan(problem, truth).costs[start]
    return float(paid / least - 1)
