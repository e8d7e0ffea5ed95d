"""A grid over a layout's free space, its costs-to-go for a reward, and how to descend them.

The goal is one of the grid's nodes. Features are integrated along the grid's edges as along any
path, so that inverse reinforcement learning can compare demonstrated paths with those on the grid.

The grid's edges form a graph whose edges have features. Weights turn these features into costs, and
Dijkstra's algorithm finds the cheapest paths to the goal.

Demonstrations are paths to the goal. Weights are inferred by comparing each demonstration with
alternative paths.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from manip_il.errors import ManipError
from manip_il.mdp import F64, I64
from manip_il.robots.reach import reach_of
from manip_il.robots.robot import Robot
from manip_il.tasks.carry.layout import Layout, Reward

LENGTH = 0  # feature that every edge has; other weights are given relative to its weight
_EVERY, _FEW = 5, 5  # the first stage takes every fifth demonstration, if that leaves at least five
_DIGITS = 6  # decimals [m] to which the features of equal paths agree
_SAME = 1e-6  # largest difference between equal feature sums [m]


@dataclass(frozen=True)
class PathProblem:
    """A graph with S nodes, E edges with K features each, and one goal.

    Attributes:
        edges: The nodes (from, to) of each edge, (E, 2), each pair once, without self-loops.
        features: The features of each edge, (E, K), 0 or more. The first one is the edge's length
            [m], above 0; another may be the part of this length that lies above an object on the
            table [m].
        nodes: The number of nodes, S.
        goal: The goal's node number.
    """

    edges: I64
    features: F64
    nodes: int
    goal: int

    @cached_property
    def numbers(self) -> Any:
        """Edge numbers, counted from 1, as a sparse matrix (from, to), (S, S)."""
        numbers = np.arange(1, len(self.edges) + 1)
        return csr_array((numbers, self.edges.T), shape=(self.nodes, self.nodes))

    def matrix(self, values: F64) -> Any:
        """Return the edges' values (E,) as a sparse matrix (from, to), (S, S).

        Zeros are stored, too.
        """
        numbers = self.numbers
        return csr_array(
            (values[numbers.data - 1], numbers.indices, numbers.indptr), shape=numbers.shape
        )

    def sums(self, path: I64) -> F64:
        """Return the feature sums (K,) over the edges of a path of nodes (n,).

        Raises:
            ManipError: If no edge joins two consecutive nodes.
        """
        edges = np.array([self.numbers[pair] for pair in pairwise(path.tolist())], np.int64) - 1
        if (edges < 0).any():
            raise ManipError("no edge joins two consecutive nodes of a path")
        return self.features[edges].sum(axis=0)


@dataclass(frozen=True)
class Plan:
    """The cheapest path to the goal from every node.

    Attributes:
        problem: The graph and its features.
        costs: The cost of each node's path, (S,), infinite if no path leads to the goal.
        following: The next node on each node's path, (S,), negative at the goal and if there is no
            path.
    """

    problem: PathProblem
    costs: F64
    following: I64

    def path(self, start: int) -> tuple[I64, F64]:
        """Return the path from a node to the goal.

        Args:
            start: The number of the node where the path begins.

        Returns:
            The path's nodes (n,), of which the last is the goal, and its feature sums (K,).

        Raises:
            ManipError: If no path leads from `start` to the goal.
        """
        if not np.isfinite(self.costs[start]):
            raise ManipError(f"no path leads from node {start} to the goal")
        path = [start]
        while path[-1] != self.problem.goal:
            path.append(int(self.following[path[-1]]))
        nodes = np.array(path, np.int64)
        return nodes, self.problem.sums(nodes)


def plan(problem: PathProblem, weights: F64, margins: F64 | float = 0.0) -> Plan:
    """Return the cheapest path from every node, by Dijkstra's algorithm backwards from the goal.

    Args:
        problem: The graph and its features.
        weights: The cost of each feature, (K,), 0 or more.
        margins: What is subtracted from the edges' costs, (E,); none may become negative.
    """
    costs = problem.matrix(problem.features @ weights - margins)
    return Plan(problem, *dijkstra(costs.T.tocsr(), indices=problem.goal, return_predecessors=True))


@dataclass(frozen=True)
class Demonstration:
    """A demonstrated path of nodes (n,) to the goal of a problem."""

    problem: PathProblem
    path: I64

    @property
    def start(self) -> int:
        """First node."""
        return int(self.path[0])

    @cached_property
    def sums(self) -> F64:
        """Feature sums along the path, (K,)."""
        return self.problem.sums(self.path)


def stages(demonstrations: Sequence[Demonstration]) -> list[Sequence[Demonstration]]:
    """Return the sets of demonstrations to fit in turn.

    The first set is every fifth one, and is skipped if these are too few; the last set is all.
    """
    few = demonstrations[::_EVERY]
    return [few, demonstrations] if len(few) >= _FEW else [demonstrations]


def rivals(
    demonstrations: Sequence[Demonstration], tastes: F64, known: Sequence[F64] = ()
) -> list[F64]:
    """Return the feature sums of each demonstration and of its alternatives.

    Alternatives are the paths that are cheapest for one of the weight vectors.

    Args:
        demonstrations: The demonstrated paths.
        tastes: The weight vectors, (n, K).
        known: The result for other weight vectors, to which the alternatives are added.

    Returns:
        The distinct feature sums for each demonstration, (m, K); its own come first.
    """
    found = []
    for one, before in zip(
        demonstrations, known or [d.sums[None] for d in demonstrations], strict=True
    ):
        more = [plan(one.problem, taste).path(one.start)[1] for taste in tastes]
        every = np.concatenate([before, more])
        _, first = np.unique(every.round(_DIGITS), axis=0, return_index=True)
        found.append(every[np.sort(first)])
    return found


def open_features(demonstrations: Sequence[Demonstration], sums: Sequence[F64]) -> list[int]:
    """Return the indices of the features whose weights are not identified.

    In these features no demonstration differs from its alternatives `sums` (m, K).
    """
    off = [
        np.abs(others - one.sums).max(axis=0)
        for one, others in zip(demonstrations, sums, strict=True)
    ]
    return [int(k) for k in np.flatnonzero(np.max(off, axis=0) <= _SAME)]


CELL = 0.02  # grid spacing, at full scale [m]
BEYOND = 0.09  # how far the grid extends beyond the workspace's half width, at full scale [m]
TOP = 0.32  # height of the grid over the table, at full scale [m]
LIFTED = 0.02  # least height of the object over its resting height, except near the goal [m]
# sideways distance from the goal within which the object may be lower, at full scale [m]
DOWN = 0.03
AHEAD = 3  # how far the descent looks ahead [cells]
OUTSIDE = 0.12  # largest distance to a node with a path if none is nearby, at full scale [m]
KEPT = 26  # plans cached per process: one per environment in lockstep, and one more
# softmin over nodes: temperature as path length [m]; share of price added to near nodes
_STEEP, _SHORT = 0.004, 0.3
# shares of a line at which its room and its costs are evaluated
_QUARTERS = np.array([0.25, 0.5, 0.75])
_LOOK = 24  # most points of a snapped path, a quarter cell apart, that one edge may replace
# lack of room that a line may have, because it may start beside a node with none to spare [m]
_SLACK = 0.003
# how much less room than at the start is tolerated on the way out of a tight place [m]
_WORSE = 1e-4


class _Links(NamedTuple):
    """Edges of a grid, sorted by the node they leave."""

    edges: I64  # (E, 2): numbers of the nodes, from and to
    fine: I64  # (E, 3): from, middle and to, as numbers of points on a grid twice as fine
    cells: F64  # (E,): lengths, in cells from `_links`, in [m] from `Grid._links`


@lru_cache(4)
def _links(shape: tuple[int, ...]) -> _Links:
    steps = np.array([step for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]) - 1
    places = _indices(shape)
    to = places[:, None] + steps
    inside = ((to >= 0) & (to < shape)).all(axis=2)
    start, way = np.nonzero(inside)
    edges = np.stack([start, _numbers(to[inside], shape)], axis=1)
    ends = _numbers(2 * places, _finer(shape))[edges]
    fine = np.insert(ends, 1, ends.sum(axis=1) // 2, axis=1)
    return _Links(edges, fine, np.linalg.norm(steps, axis=1)[way])


def _finer(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Shape of a grid twice as fine."""
    return tuple(2 * count - 1 for count in shape)


def _indices(shape: tuple[int, ...]) -> I64:
    """Indices (S, 3) of all nodes along x, y and z."""
    return np.argwhere(np.ones(shape, bool))


def _numbers(index: I64, shape: tuple[int, ...]) -> I64:
    """Numbers (n,) of the nodes with indices (n, 3)."""
    return np.asarray(np.ravel_multi_index(tuple(index.T), shape), np.int64)


class Grid:
    """Nodes of a layout's free space, each joined to the 26 around it.

    Attributes:
        layout: What stands on the table, and the goal.
        shape: The node counts along x, y and z.
        origin: The first node's place, (3,) [m].
        cell: The spacing of the nodes [m].
        goal: The goal's node number.
    """

    def __init__(self, layout: Layout, robot: Robot):
        self.layout = layout
        self.cell = CELL * layout.scale
        self._robot = robot
        (x, y), half = robot.workspace.centre, robot.workspace.half_width + BEYOND * layout.scale
        goal, low = np.array(layout.goal), np.array([x - half, y - half, 0.0])
        sizes = np.array([2 * half, 2 * half, TOP * layout.scale])
        before = np.floor((goal - low) / self.cell + 1e-9).astype(np.int64)  # nodes before the goal
        self.origin = goal - self.cell * before
        counts = np.maximum(np.floor(sizes / self.cell + 1e-9).astype(np.int64), before) + 1
        self.shape: tuple[int, ...] = tuple(counts.tolist())
        self.goal = int(_numbers(before.clip(0), self.shape))

    @cached_property
    def points(self) -> F64:
        """Places of the nodes, (S, 3) [m]."""
        return self.origin + self.cell * _indices(self.shape)

    @cached_property
    def _fine(self) -> F64:
        """Places of nodes and of the points halfway between them, (F, 3) [m]."""
        return self.origin + self.cell / 2 * _indices(_finer(self.shape))

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Whether an object may be at each node, (S,).

        It must be within reach, clear of obstacles, and lifted unless it is near the goal.
        """
        layout, points = self.layout, self.points
        off = np.hypot(*(points[:, :2] - np.array(layout.goal[:2])).T)
        low = (points[:, 2] < layout.half + LIFTED - 1e-9) & (off > DOWN * layout.scale)
        found = reach_of(self._robot).has_each(points) & (layout.room(points) >= 0) & ~low
        found[self.goal] |= bool(layout.room(points[[self.goal]])[0] >= 0)
        return found

    @cached_property
    def _links(self) -> _Links:
        """Edges that are free from end to end."""
        every = _links(self.shape)
        kept: NDArray[np.bool_] = np.all(self.free[every.edges], axis=1)
        middles = every.fine[kept, 1]
        kept[kept] = self.layout.room(self._fine[middles]) >= 0
        return _Links(every.edges[kept], every.fine[kept], self.cell * every.cells[kept])

    def _integrals(self, densities: F64) -> F64:
        """Integrals (E, K) along the edges of densities (F, K) at nodes and middles, by
        Simpson's rule.
        """
        start, middle, end = (densities[places] for places in self._links.fine.T)
        return self._links.cells[:, None] * (start + 4 * middle + end) / 6

    @cached_property
    def problem(self) -> PathProblem:
        """The grid as a problem for inverse reinforcement learning.

        Features are integrated along each edge.
        """
        return self._problem(self._integrals(self.layout.densities(self._fine)), self.goal)

    def costs_to_go(self, weights: F64) -> F64:
        """Return the cost of the cheapest path from each node to the goal, (S,).

        Args:
            weights: The cost per metre of each feature, (K,).
        """
        prices = self.layout.densities(self._fine) @ weights
        return self._shortest(self._integrals(prices[:, None]), self.goal).costs

    def _problem(self, features: F64, goal: int) -> PathProblem:
        return PathProblem(self._links.edges, features, len(self.points), goal)

    def _shortest(self, costs: F64, goal: int) -> Plan:
        """The cheapest paths to a node for costs (E, 1) of the edges."""
        return plan(self._problem(costs, goal), np.ones(1))

    def near(self, position: F64) -> I64:
        """Return the free nodes within `AHEAD` cells of a position (3,) [m], (n,)."""
        around = np.round((position - self.origin) / self.cell).astype(np.int64) + _AROUND
        inside = around[((around >= 0) & (around < self.shape)).all(axis=1)]
        nodes = _numbers(inside, self.shape)
        nodes = nodes[self.free[nodes]]
        return nodes[np.linalg.norm(self.points[nodes] - position, axis=1) < AHEAD * self.cell]

    def snap(self, positions: F64) -> I64:
        """Return a path of free nodes, (n,), that follows positions (T, 3) [m].

        Each node is joined to the next. If the positions lie on a straight line, the path is no
        longer than the shortest path in the grid. Gaps without free nodes are bridged by the
        shortest path. If the positions end near the goal, the path is extended to it.
        """
        dense = _dense(positions, self.cell / 4)
        index = (
            np.round((dense - self.origin) / self.cell)
            .astype(np.int64)
            .clip(0, np.array(self.shape) - 1)
        )
        every = _numbers(index, self.shape)
        nodes: list[int] = every[self.free[every]].tolist()
        if np.linalg.norm(positions[-1] - self.points[self.goal]) < AHEAD * self.cell:
            nodes.append(self.goal)
        path = nodes[:1]
        while path and path[-1] != nodes[-1]:
            # skips detours that return to this node
            begin = len(nodes) - 1 - nodes[::-1].index(path[-1])
            nodes = nodes[begin:]
            joined = self.problem.numbers[path[-1], nodes[:_LOOK]].nonzero()[-1]
            last = int(joined.max(initial=0))
            path += [nodes[last]] if last else self._between(path[-1], nodes[1])
            nodes = nodes[last or 1 :]
        return np.array(path, np.int64)

    def _between(self, start: int, end: int) -> list[int]:
        nodes, _ = self._shortest(self._links.cells[:, None], end).path(start)
        return nodes[1:].tolist()


_AROUND = np.array([step for step in np.ndindex(*[2 * AHEAD + 1] * 3)]) - AHEAD


def _dense(positions: F64, step: float) -> F64:
    """A path (T, 3) with points added so that they are at most `step` apart [m]."""
    found = [positions[:1]]
    for start, end in pairwise(positions):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / step)))
        found.append(start + np.linspace(0, 1, count + 1)[1:, None] * (end - start))
    return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class Descent:
    """Costs-to-go of a grid, and how to descend them from any position.

    Attributes:
        grid: The grid of the layout.
        costs: The cost-to-go of each node, (S,).
        weights: The cost per metre of each feature, (K,).
    """

    grid: Grid
    costs: F64
    weights: F64

    def leads(self, position: F64) -> bool:
        """Return whether a path leads to the goal from any node near a position (3,) [m]."""
        return len(self._around(position)) > 0

    def _around(self, position: F64) -> I64:
        """Numbers (n,) of nodes with a path: those within `AHEAD` cells of a position (3,) [m],
        else the nearest.
        """
        nodes = self.grid.near(position)
        nodes = nodes[np.isfinite(self.costs[nodes])]
        if len(nodes):
            return nodes
        off = np.where(
            np.isfinite(self.costs), np.linalg.norm(self.grid.points - position, axis=1), np.inf
        )
        nearest = int(np.argmin(off))
        return np.array(
            [nearest] if off[nearest] < OUTSIDE * self.grid.layout.scale else [], np.int64
        )

    def look(self, position: F64) -> tuple[float, F64 | None]:
        """Return the cost-to-go at a position (3,) [m], and a point to head for.

        The cost is that of the cheapest way, a straight line to a node and the path from there. The
        point (3,) [m] is about `AHEAD` cells away. The cost is infinite, and the point None, if no
        free line leads to a node with a path.
        """
        nodes = self._around(position)
        ends = self.grid.points[nodes]
        if not len(nodes):
            return np.inf, None
        layout, here = self.grid.layout, position[None]
        spare = min(-_SLACK, float(layout.room(here)[0]) - _WORSE)
        points = (position + _QUARTERS[:, None, None] * (ends - position)).reshape(-1, 3)
        free: NDArray[np.bool_] = np.all(
            layout.room(points).reshape(len(_QUARTERS), -1) >= spare, axis=0
        )
        if not free.any():
            return np.inf, None
        price = float(self._prices(here)[0])
        between = self._prices(points).reshape(len(_QUARTERS), -1)
        # Simpson's rule
        means = (price + np.array([4.0, 2.0, 4.0]) @ between + self._prices(ends)) / 12
        off = np.linalg.norm(ends - position, axis=1)
        totals = off * means + self.costs[nodes]
        nodes = nodes[free]
        ends = ends[free]
        totals = totals[free]
        off = off[free]
        # The mean of the best nodes, farther ones preferred, changes smoothly with the position.
        near = AHEAD * self.grid.cell - off
        late = totals + np.where(nodes == self.grid.goal, 0.0, _SHORT * price * near)
        shares = np.exp(-(late - late.min()) / (_STEEP * layout.scale * price))
        shares *= np.clip(near / self.grid.cell, 0.0, 1.0) + 1e-6
        mean = shares @ ends / shares.sum()
        if not layout.is_free(position, mean, spare):
            mean = ends[int(np.argmin(late))]
        return float(totals.min()), mean

    def _prices(self, points: F64) -> F64:
        """Return what a metre of path costs at points (N, 3), (N,)."""
        return self.grid.layout.densities(points) @ self.weights


@lru_cache(KEPT)
def descent(layout: Layout, reward: Reward, robot: Robot) -> Descent:
    """Return a layout's costs-to-go for a reward, which are cached once computed.

    Args:
        layout: What stands on the table, and the goal.
        reward: What a metre of path costs.
        robot: The arm, whose reach bounds the grid.
    """
    grid, weights = Grid(layout, robot), np.array(reward.weights)
    return Descent(grid, grid.costs_to_go(weights), weights)
