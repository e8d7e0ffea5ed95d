"""Bayesian inverse reinforcement learning (Ramachandran & Amir 2007): a posterior of the weights.

Prior: the weights are independent, each exponential with mean `PRIOR` [1/m]. Likelihood: the
demonstrator chooses among its own path and those that are cheapest for some other weights
("tastes"), in proportion to exp(-w . features). All these paths are sensible, and better ones are
more likely; the sum over them is exact, and short enough for chains of tens of thousands of steps.
Tastes are drawn from the prior, then from the posterior, which finds paths of nearly equal cost.
The posterior is sampled by random-walk Metropolis in log w; its steps are tuned in warm-ups, then
fixed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from manip_il.mdp import F64, I64
from manip_il.tasks.carry.grid import Demonstration, rivals

Density = Callable[[F64], F64]  # log-densities (C,) at points (C, K)
PRIOR = 300.0  # mean of a weight [1/m]
TASTES = 60  # weight vectors drawn from the prior, the same for all demonstrations
CHAINS = 4  # drawn at once
_ROUNDS, _MORE = 3, 30  # rounds of drawing tastes from the posterior, and tastes per round
_DRAWS, _WARM_UP = 10_000, 2_000  # steps of a chain and of each warm-up
_FIRST, _FITS = 0.3, 2  # initial step size, and number of warm-ups; each one tunes the steps
# random walk's step in standard deviations, before division by sqrt(dimension) (Roberts et al.
# 1997)
_STEP = 2.38


@dataclass(frozen=True)
class Choices:
    """The paths that the demonstrators chose among, one block of rows per demonstration.

    Attributes:
        excess: A path's features minus the demonstration's, (m, K) [m]. A block's first row, zeros,
            is the demonstration.
        starts: First row of each block, (D,).
    """

    excess: F64
    starts: I64

    @classmethod
    def of(cls, sums: Sequence[F64]) -> Choices:
        """Return the choices, given feature sums (m, K) for each demonstration, with its own
        path in the first row.
        """
        starts = np.cumsum([0, *map(len, sums[:-1])]).astype(np.int64)
        return cls(np.concatenate([one - one[0] for one in sums]), starts)

    def log_likelihood(self, weights: F64) -> F64:
        """Return the log-likelihood of all demonstrated choices, (C,), for weights (C, K)."""
        costs = self.excess @ weights.T
        least = np.minimum.reduceat(costs, self.starts)
        lengths = np.diff(np.append(self.starts, len(costs)))
        sums = np.add.reduceat(np.exp(np.repeat(least, lengths, axis=0) - costs), self.starts)
        return (least - np.log(sums)).sum(axis=0)


def fit(demonstrations: Sequence[Demonstration], rng: np.random.Generator) -> F64:
    """Return draws from the posterior of the weights, given the demonstrations, (N, K) [1/m].

    Each demonstration is taken as chosen over the cheapest paths for sampled weights. The cheapest
    path for the mean of the draws has the least expected cost.

    Args:
        demonstrations: One or more demonstrations, with the same K features.
        rng: Draws the sampled weights and the posterior.
    """
    size = demonstrations[0].problem.features.shape[1]
    sums = rivals(demonstrations, rng.exponential(PRIOR, (TASTES, size)))
    for _ in range(_ROUNDS):
        quick = draw_posterior(Choices.of(sums), rng, count=_DRAWS // 5)
        even = np.linspace(0, len(quick) - 1, _MORE).round().astype(np.int64)
        sums = rivals(demonstrations, quick[even], sums)
    return draw_posterior(Choices.of(sums), rng)


def draw_posterior(
    choices: Choices,
    rng: np.random.Generator,
    prior: float = PRIOR,
    count: int = _DRAWS,
) -> F64:
    """Return draws of the weights given the choices.

    Args:
        choices: The paths that the demonstrators chose among.
        rng: Draws the starts of the chains and their steps.
        prior: Prior mean of a weight [1/m].
        count: Draws per chain.

    Returns:
        The draws of all `CHAINS` chains, one chain after the other, (N, K) [1/m].
    """

    def density(logs: F64) -> F64:
        weights = np.exp(logs)
        # d w = w d log w
        return choices.log_likelihood(weights) - weights.sum(axis=1) / prior + logs.sum(axis=1)

    size = choices.excess.shape[1]
    start, root = np.log(prior * rng.uniform(0.5, 1.5, (CHAINS, size))), _FIRST * np.eye(size)
    for _ in range(_FITS):
        # the first half only leads there
        tried = sample(density, start, root, _WARM_UP, rng)[:, _WARM_UP // 2 :]
        start, spread = tried[:, -1], np.cov(tried.reshape(-1, size).T)
        root = _STEP / np.sqrt(size) * np.linalg.cholesky(spread)
    return np.exp(sample(density, start, root, count, rng).reshape(-1, size))


def sample(density: Density, start: F64, root: F64, count: int, rng: np.random.Generator) -> F64:
    """Run chains of random-walk Metropolis, all at once.

    Args:
        density: The log-density to sample from, up to a constant.
        start: First point of each chain, (C, K).
        root: Cholesky factor of the steps' covariance, (K, K).
        count: Draws per chain.
        rng: Draws the steps and decides which are accepted.

    Returns:
        The draws, (C, count, K).
    """
    chains, size = start.shape
    now, height = start, density(start)
    points = np.empty((chains, count, size))
    for step in range(count):
        proposed = now + rng.standard_normal((chains, size)) @ root.T
        there = density(proposed)
        accept = np.log(rng.random(chains)) < there - height
        now, height = np.where(accept[:, None], proposed, now), np.where(accept, there, height)
        points[:, step] = now
    return points
