"""Paths to a goal as a finite decision process: named costs an edge, the cheapest path by Dijkstra.

Every edge has features, and weights turn them into its cost; states are nodes, actions the edges that leave them, and
the goal keeps who reaches it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from manip_il.errors import ManipError, MismatchError
from manip_il.rewards.finite import FiniteMDP

F64, I64, I32 = NDArray[np.float64], NDArray[np.int64], NDArray[np.int32]
NOWHERE = -1  # as the node that follows: none
_UNREACHED = 1e6  # times the dearest edge: what a step costs in `to_mdp` where no edge leaves


@dataclass(frozen=True)
class PathProblem:
    """S nodes, E edges with K features each, one goal.

    edges: (E, 2), from and to, each pair once and none from a node to itself. features: (E, K), 0 or more, such as
    metres of the edge above a thing. Raises `MismatchError` for shapes that do not fit, `ManipError` for edges between
    nodes that are not there, pairs twice, and features that are negative or not finite.
    """

    edges: I64
    features: F64
    nodes: int
    goal: int

    def __post_init__(self) -> None:
        if self.edges.ndim != 2 or self.edges.shape[1] != 2:
            raise MismatchError("shape", "the edges", self.edges.shape, "a path problem", "(E, 2)")
        if self.features.ndim != 2 or len(self.features) != len(self.edges):
            raise MismatchError("shape", "the features", self.features.shape, "the edges", (len(self.edges), "K"))
        least, most = self.edges.min(initial=self.goal), self.edges.max(initial=self.goal)
        if least < 0 or most >= self.nodes:
            raise ManipError(f"edges or goal name nodes {least} to {most}; expected 0 to {self.nodes - 1}")
        if (self.edges[:, 0] == self.edges[:, 1]).any():
            raise ManipError("an edge leads from a node to itself")
        if (np.diff(self._keys()) == 0).any():
            raise ManipError("two edges have the same nodes; expected one edge from a node to another")
        if not np.isfinite(self.features).all() or self.features.min(initial=0.0) < 0:
            raise ManipError("a feature of an edge is negative or not finite")

    @cached_property
    def order(self) -> I32:
        """Edges sorted by the node they leave, then by the one they lead to, (E,)."""
        return np.argsort(self.edges[:, 0] * self.nodes + self.edges[:, 1], kind="stable").astype(np.int32)

    def _keys(self) -> I64:
        return self.edges[self.order, 0] * self.nodes + self.edges[self.order, 1]

    @cached_property
    def _outgoing(self) -> tuple[I32, I32]:
        """The nodes that the edges in `order` lead to (E,), and where each node's edges begin there (S + 1,)."""
        return self.edges[self.order, 1].astype(np.int32), self._starts(0)

    @cached_property
    def _incoming(self) -> tuple[I32, I32, I32]:
        """Edges sorted by the node they lead to (E,), the nodes they leave (E,), where each node's begin (S + 1,)."""
        order = np.argsort(self.edges[:, 1], kind="stable").astype(np.int32)
        return order, self.edges[order, 0].astype(np.int32), self._starts(1)

    def _starts(self, side: int) -> I32:
        counts = np.bincount(self.edges[:, side], minlength=self.nodes)
        return np.append(0, np.cumsum(counts)).astype(np.int32)

    def costs(self, weights: F64) -> F64:
        """Return what every edge costs, (E,), for weights (K,). Raises `ManipError` for a cost below 0."""
        if np.shape(weights) != self.features.shape[1:]:
            raise MismatchError("shape", "the weights", np.shape(weights), "the features", self.features.shape[1:])
        found = self.features @ weights
        if not np.isfinite(found).all() or found.min(initial=0.0) < 0:
            raise ManipError(f"an edge costs {found.min():.3g}; expected 0 or more: with less, no path is the cheapest")
        return found

    def matrix(self, values: F64) -> Any:
        """Return values of the edges (E,) as a sparse matrix from -> to, (S, S). Zeros stay entries."""
        return csr_array((values[self.order], *self._outgoing), shape=(self.nodes, self.nodes))

    def backwards(self, values: F64) -> Any:
        """Return values of the edges (E,) as a sparse matrix to -> from, (S, S). Zeros stay entries."""
        order, before, starts = self._incoming
        return csr_array((values[order], before, starts), shape=(self.nodes, self.nodes))

    def edges_of(self, path: I64) -> I64:
        """Return the edges along a path of nodes (n,), (n - 1,). Raises `ManipError` where two are not joined."""
        wanted = path[:-1] * self.nodes + path[1:]
        keys = self._keys()
        at = np.searchsorted(keys, wanted).clip(max=max(len(keys) - 1, 0))
        if len(wanted) and (not len(keys) or (keys[at] != wanted).any()):
            raise ManipError("a path goes where no edge leads")
        return self.order[at].astype(np.int64)

    def sums(self, path: I64) -> F64:
        """Return the features of a path of nodes (n,), summed over its edges, (K,)."""
        return self.features[self.edges_of(path)].sum(axis=0)

    def to_mdp(self, weights: F64, start: int) -> FiniteMDP:
        """Return the same as a process of S states; action a takes a node's edge a, or its last one where it has fewer.

        weights: (K,). The goal keeps who is there at no cost; a node without edges does so at a high one.
        """
        costs, (leads, starts) = self.costs(weights)[self.order], self._outgoing
        counts = np.diff(starts)
        actions = np.minimum(np.arange(counts.max(initial=1)), np.maximum(counts, 1)[:, None] - 1)
        edge = np.minimum(starts[:-1, None] + actions, max(len(costs) - 1, 0))
        stays = np.arange(self.nodes) == self.goal
        stuck = (counts == 0) & ~stays
        to = np.where((stays | stuck)[:, None], np.arange(self.nodes)[:, None], leads[edge])
        paid = np.where(stays[:, None], 0.0, costs[edge])
        paid[stuck] = _UNREACHED * costs.max(initial=1.0)
        rows = np.arange(to.size + 1)
        moves = csr_array((np.ones(to.size), to.ravel(), rows), shape=(to.size, self.nodes))
        return FiniteMDP(moves, -paid, np.eye(self.nodes)[start])


@dataclass(frozen=True)
class Plan:
    """The cheapest way to the goal from everywhere.

    costs: (S,), infinite where no path leads to the goal. following: the next node, (S,), `NOWHERE` at the goal and
    where no path leads.
    """

    costs: F64
    following: I64


def plan(problem: PathProblem, weights: F64) -> Plan:
    """Return the cheapest way from every node for weights (K,). Raises what `PathProblem.costs` raises."""
    return plan_edges(problem, problem.costs(weights))


def plan_edges(problem: PathProblem, costs: F64) -> Plan:
    """Return the cheapest way from every node for costs of edges (E,), 0 or more: Dijkstra backwards from the goal."""
    found, following = dijkstra(problem.backwards(costs), indices=problem.goal, return_predecessors=True)
    return Plan(found, np.where(following < 0, NOWHERE, following).astype(np.int64))


def costs_to_go(problem: PathProblem, weights: F64) -> F64:
    """Return the cost of the cheapest path from every node, (S,), for weights (K,); infinite where there is none."""
    return plan(problem, weights).costs


def cheapest_path(problem: PathProblem, planned: Plan, start: int) -> tuple[I64, F64]:
    """Return the nodes of a plan's path from a start, (n,), and its feature sums, (K,).

    Raises `ManipError` where no path leads to the goal.
    """
    if not np.isfinite(planned.costs[start]):
        raise ManipError(f"no path leads from node {start} to the goal")
    path = [start]
    while path[-1] != problem.goal:
        path.append(int(planned.following[path[-1]]))
    nodes = np.array(path, np.int64)
    return nodes, problem.sums(nodes)
