"""Paths to a goal over a graph whose edges have features: weights turn them into costs, Dijkstra finds the cheapest.

Demonstrations are such paths; what they were preferred to tells about the weights, and leaves some of them open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from manip_il.errors import ManipError

F64, I64 = NDArray[np.float64], NDArray[np.int64]
NOWHERE = -1  # as the node that follows: none
LENGTH = 0  # the feature that every edge has, over whose weight the others are given
_FIFTH, _FEW = 5, 5  # of how many demonstrations one is a beginning, and how many are that at least
_DIGITS = 6  # decimals [m] in which the features of different paths differ
_SAME = 1e-6  # [m] that sums of a feature may differ by and be the same


@dataclass(frozen=True)
class PathProblem:
    """S nodes, E edges with K features each, one goal.

    edges: (E, 2), from and to, each pair once and none from a node to itself. features: (E, K), 0 or more, such as
    metres of the edge above a thing; the first is the edge's length, above 0.
    """

    edges: I64
    features: F64
    nodes: int
    goal: int

    @cached_property
    def _numbers(self) -> Any:
        """Numbers of the edges, from 1 on, as a sparse matrix from -> to, (S, S)."""
        return csr_array((np.arange(1, len(self.edges) + 1), self.edges.T), shape=(self.nodes, self.nodes))

    def costs(self, weights: F64) -> F64:
        """Return what every edge costs, (E,), for weights (K,), 0 or more."""
        return self.features @ weights

    def matrix(self, values: F64) -> Any:
        """Return values of the edges (E,) as a sparse matrix from -> to, (S, S). Zeros stay entries."""
        numbers = self._numbers
        return csr_array((values[numbers.data - 1], numbers.indices, numbers.indptr), shape=numbers.shape)

    def edges_of(self, path: I64) -> I64:
        """Return the edges along a path of nodes (n,), (n - 1,). Raises `ManipError` if two are not joined."""
        numbers = self._numbers
        found = np.array([numbers[pair] for pair in pairwise(path.tolist())], np.int64) - 1
        if (found < 0).any():
            raise ManipError("a path goes where no edge leads")
        return found

    def sums(self, path: I64) -> F64:
        """Return the features of a path of nodes (n,), summed over its edges, (K,)."""
        return self.features[self.edges_of(path)].sum(axis=0)


@dataclass(frozen=True)
class Plan:
    """The cheapest way to the goal from everywhere.

    costs: (S,), infinite where no path leads to the goal. following: the next node, (S,), `NOWHERE` at the goal and
    where no path leads.
    """

    costs: F64
    following: I64


def plan(problem: PathProblem, weights: F64) -> Plan:
    """Return the cheapest way from every node for weights (K,)."""
    return plan_edges(problem, problem.costs(weights))


def plan_edges(problem: PathProblem, costs: F64) -> Plan:
    """Return the cheapest way from every node for costs of edges (E,), 0 or more: Dijkstra backwards from the goal."""
    found, following = dijkstra(problem.matrix(costs).T.tocsr(), indices=problem.goal, return_predecessors=True)
    return Plan(found, np.where(following < 0, NOWHERE, following).astype(np.int64))


def cheapest_path(problem: PathProblem, planned: Plan, start: int) -> tuple[I64, F64]:
    """Return the nodes of a plan's path from a start, (n,), and its feature sums, (K,).

    Raises `ManipError` if no path leads to the goal.
    """
    if not np.isfinite(planned.costs[start]):
        raise ManipError(f"no path leads from node {start} to the goal")
    path = [start]
    while path[-1] != problem.goal:
        path.append(int(planned.following[path[-1]]))
    nodes = np.array(path, np.int64)
    return nodes, problem.sums(nodes)


@dataclass(frozen=True)
class Demonstration:
    """A path of nodes (n,) that somebody took from a start to the goal of a problem."""

    problem: PathProblem
    path: I64

    @property
    def start(self) -> int:
        """The node it begins at."""
        return int(self.path[0])

    @cached_property
    def sums(self) -> F64:
        """Features summed along it, (K,)."""
        return self.problem.sums(self.path)


def stages(demonstrations: Sequence[Demonstration]) -> list[Sequence[Demonstration]]:
    """Return what to fit one after the other: a fifth of many demonstrations, as a beginning, then all."""
    few = demonstrations[::_FIFTH]
    return [few, demonstrations] if len(few) >= _FEW else [demonstrations]


def rivals(demonstrations: Sequence[Demonstration], tastes: F64) -> list[F64]:
    """Return what each demonstration competes with: sums of the paths that are cheapest for tastes (n, K), each once.

    The demonstration's own sums stand first: (m, K), m at most n + 1.
    """
    return add_rivals(demonstrations, [one.sums[None] for one in demonstrations], tastes)


def add_rivals(demonstrations: Sequence[Demonstration], sums: Sequence[F64], tastes: F64) -> list[F64]:
    """Return sums (m, K) of each demonstration's rivals, and those for more tastes (n, K) that are not there yet."""
    found = []
    for one, known in zip(demonstrations, sums, strict=True):
        more = [cheapest_path(one.problem, plan(one.problem, taste), one.start)[1] for taste in tastes]
        every = np.concatenate([known, more])
        _, first = np.unique(every.round(_DIGITS), axis=0, return_index=True)
        found.append(every[np.sort(first)])
    return found


def open_features(demonstrations: Sequence[Demonstration], sums: Sequence[F64]) -> list[int]:
    """Return the features in which every demonstration agrees with all its rivals (m, K): their weights are open."""
    off = [np.abs(others - one.sums).max(axis=0) for one, others in zip(demonstrations, sums, strict=True)]
    return [int(k) for k in np.flatnonzero(np.max(off, axis=0) <= _SAME)]
