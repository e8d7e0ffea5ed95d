"""Demonstrated paths, the paths they were preferred to, and what they leave open about the weights of their costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards.paths import PathProblem, cheapest_path, plan

F64, I64 = NDArray[np.float64], NDArray[np.int64]
LENGTH = 0  # the feature that every edge has, over whose weight the others are given
_FIFTH, _FEW = 5, 5  # of how many demonstrations one is a beginning, and how many are that at least
_DIGITS = 6  # decimals [m] in which the features of different paths differ
_SAME = 1e-6  # [m] that sums of a feature may differ by and be the same


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
