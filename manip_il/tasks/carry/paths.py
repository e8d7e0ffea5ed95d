"""Paths to a goal on a graph whose edges have features: weights turn features into costs, Dijkstra finds cheap paths.

Demonstrations are paths to the goal. Weights are inferred by comparing each demonstration with alternative paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from manip_il.errors import ManipError
from manip_il.mdp import F64, I64

LENGTH = 0  # feature that every edge has; other weights are given relative to its weight
_EVERY, _FEW = 5, 5  # the first stage takes every fifth demonstration, if that leaves at least five
_DIGITS = 6  # decimals [m] to which the features of equal paths agree
_SAME = 1e-6  # largest difference between equal feature sums [m]


@dataclass(frozen=True)
class PathProblem:
    """S nodes, E edges with K features each, one goal.

    edges: nodes (from, to), (E, 2), each pair once, without self-loops. features: (E, K), 0 or more; the first one is
    the edge's length [m], above 0; another may be the part of this length that lies above an object on the table [m].
    """

    edges: I64
    features: F64
    nodes: int
    goal: int

    @cached_property
    def numbers(self) -> Any:
        """Edge numbers, counted from 1, as a sparse matrix (from, to), (S, S)."""
        return csr_array((np.arange(1, len(self.edges) + 1), self.edges.T), shape=(self.nodes, self.nodes))

    def costs(self, weights: F64) -> F64:
        """Return the cost of every edge, (E,), for non-negative weights (K,)."""
        return self.features @ weights

    def matrix(self, values: F64) -> Any:
        """Return the edges' values (E,) as a sparse matrix (from, to), (S, S). Zeros are stored, too."""
        numbers = self.numbers
        return csr_array((values[numbers.data - 1], numbers.indices, numbers.indptr), shape=numbers.shape)

    def sums(self, path: I64) -> F64:
        """Return the feature sums (K,) over the edges of a path of nodes (n,). Raises `ManipError` without one."""
        edges = np.array([self.numbers[pair] for pair in pairwise(path.tolist())], np.int64) - 1
        if (edges < 0).any():
            raise ManipError("no edge joins two consecutive nodes of a path")
        return self.features[edges].sum(axis=0)


@dataclass(frozen=True)
class Plan:
    """The cheapest path to the goal from every node.

    costs: (S,), infinite if no path leads to the goal. following: the next node, (S,), negative at the goal and if
    there is no path.
    """

    costs: F64
    following: I64


def plan(problem: PathProblem, weights: F64) -> Plan:
    """Return the cheapest path from every node for weights (K,)."""
    return plan_edges(problem, problem.costs(weights))


def plan_edges(problem: PathProblem, costs: F64) -> Plan:
    """Return the cheapest path from every node for edge costs (E,), 0 or more: Dijkstra backwards from the goal."""
    found, following = dijkstra(problem.matrix(costs).T.tocsr(), indices=problem.goal, return_predecessors=True)
    return Plan(found, following)


def cheapest_path(problem: PathProblem, planned: Plan, start: int) -> tuple[I64, F64]:
    """Return the nodes (n,) and feature sums (K,) of a plan's path from node `start`.

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
    """Return the sets of demonstrations to fit in turn: every fifth one (skipped if these are too few), then all."""
    few = demonstrations[::_EVERY]
    return [few, demonstrations] if len(few) >= _FEW else [demonstrations]


def rivals(demonstrations: Sequence[Demonstration], tastes: F64) -> list[F64]:
    """Return the feature sums (m, K) of each demonstration's alternatives.

    Alternatives are the distinct paths that are cheapest for one of the weight vectors `tastes` (n, K). The
    demonstration's own sums come first, so m is at most n + 1.
    """
    return add_rivals(demonstrations, [one.sums[None] for one in demonstrations], tastes)


def add_rivals(demonstrations: Sequence[Demonstration], sums: Sequence[F64], tastes: F64) -> list[F64]:
    """Return the `sums` of `rivals`, (m, K) each, with the alternatives for further weight vectors `tastes` (n, K)."""
    found = []
    for one, known in zip(demonstrations, sums, strict=True):
        more = [cheapest_path(one.problem, plan(one.problem, taste), one.start)[1] for taste in tastes]
        every = np.concatenate([known, more])
        _, first = np.unique(every.round(_DIGITS), axis=0, return_index=True)
        found.append(every[np.sort(first)])
    return found


def open_features(demonstrations: Sequence[Demonstration], sums: Sequence[F64]) -> list[int]:
    """Return the indices of the features in which no demonstration differs from its alternatives `sums` (m, K).

    The weights of these features are not identified.
    """
    off = [np.abs(others - one.sums).max(axis=0) for one, others in zip(demonstrations, sums, strict=True)]
    return [int(k) for k in np.flatnonzero(np.max(off, axis=0) <= _SAME)]
