"""Bayesian inverse reinforcement learning (Ramachandran & Amir 2007): what the demonstrations leave of the weights.

Prior: the weights are independent, each exponential with mean `PRIOR` [1/m]. Likelihood: of the paths that are the
cheapest for some taste, and its own, a demonstration takes one with a probability in proportion to exp(-w . features).
So a demonstrator chooses between sensible paths, and the better one is for its taste the likelier; the sum over them is
exact, and small enough for chains of tens of thousands of steps. Tastes are drawn from the prior, and then from the
posterior, which finds the paths that nearly tie. The posterior is drawn by Metropolis steps in log w.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.rewards.demonstrations import Demonstration, add_rivals, count_features, rivals
from manip_il.rewards.mcmc import CHAINS, Draws, agreement, effective_size, sample

F64, I64 = NDArray[np.float64], NDArray[np.int64]
PRIOR = 300.0  # mean of a weight [1/m]
TASTES = 60  # of the prior, for each demonstration
_ROUNDS, _MORE = 3, 30  # rounds of tastes of the posterior
_DRAWS, _WARM_UP = 10_000, 3_000  # of a chain
_LEVEL = 0.9  # of credible intervals


@dataclass(frozen=True)
class Choices:
    """Paths that were to be chosen from, those of all demonstrations one after the other.

    excess: their features above the demonstration's own, (m, K) [m], the own first with 0. starts: where each
    demonstration's begin, (D,).
    """

    excess: F64
    starts: I64

    @classmethod
    def of(cls, sums: Sequence[F64]) -> Choices:
        """Return the choices whose features are (m, K) for each demonstration, the chosen path's first."""
        starts = np.cumsum([0, *map(len, sums[:-1])]).astype(np.int64)
        return cls(np.concatenate([one - one[0] for one in sums]), starts)

    def log_likelihood(self, weights: F64) -> F64:
        """Return the logarithm of the probability of all that was chosen, (C,), for weights (C, K)."""
        costs = self.excess @ weights.T
        least = np.minimum.reduceat(costs, self.starts)
        lengths = np.diff(np.append(self.starts, len(costs)))
        sums = np.add.reduceat(np.exp(np.repeat(least, lengths, axis=0) - costs), self.starts)
        return (least - np.log(sums)).sum(axis=0)


@dataclass(frozen=True)
class Posterior:
    """draws: of the weights [1/m]. effective, agreement: draws' worth and R-hat of their logarithms, (K,)."""

    draws: Draws
    effective: F64
    agreement: F64

    @property
    def mean(self) -> F64:
        """Mean weights, (K,) [1/m]: their cheapest path has the least expected cost."""
        return self.draws.pooled.mean(axis=0)

    def ratios(self, base: int, level: float = _LEVEL) -> F64:
        """Return the credible interval of every weight over that of feature `base`, (K, 2)."""
        pooled = self.draws.pooled
        return np.quantile(pooled / pooled[:, [base]], [(1 - level) / 2, (1 + level) / 2], axis=0).T


def draw_posterior(
    choices: Choices,
    rng: np.random.Generator,
    prior: float = PRIOR,
    count: int = _DRAWS,
    warm_up: int = _WARM_UP,
    chains: int = CHAINS,
) -> Posterior:
    """Return draws of the weights given what was chosen. prior: mean of a weight [1/m]. count: of every chain."""

    def density(logs: F64) -> F64:
        weights = np.exp(logs)
        return choices.log_likelihood(weights) - weights.sum(axis=1) / prior + logs.sum(axis=1)  # d w = w d log w

    start = np.log(prior * rng.uniform(0.5, 1.5, (chains, choices.excess.shape[1])))
    logs = sample(density, start, count, warm_up, rng)
    points = logs.points
    return Posterior(Draws(np.exp(points), logs.accepted), effective_size(points), agreement(points))


def prior_tastes(count: int, features: int, rng: np.random.Generator, prior: float = PRIOR) -> F64:
    """Return weights drawn from the prior, (count, features) [1/m]."""
    return rng.exponential(prior, (count, features))


def fit(
    demonstrations: Sequence[Demonstration], rng: np.random.Generator, prior: float = PRIOR
) -> tuple[Posterior, list[F64]]:
    """Return the posterior, and the paths' features that each demonstration's was chosen from, (m, K)."""
    sums = rivals(demonstrations, prior_tastes(TASTES, count_features(demonstrations), rng, prior))
    for _ in range(_ROUNDS):
        quick = draw_posterior(Choices.of(sums), rng, prior, _DRAWS // 5, _WARM_UP)
        sums = add_rivals(demonstrations, sums, quick.draws.thin(_MORE))
    return draw_posterior(Choices.of(sums), rng, prior), sums
