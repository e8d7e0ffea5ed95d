"""Simulation-based calibration (Talts et al. 2018): is the posterior the one that the prior and the likelihood imply?

Weights are drawn from the prior, demonstrations for them from the likelihood, and the posterior is drawn from those.
Where all is right, the rank of the true weight among the posterior's draws is uniform, and credible intervals cover it
as often as they say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chisquare

from manip_il.rewards.bayesian import Choices, draw_posterior, prior_tastes
from manip_il.rewards.paths import PathProblem

F64, I64 = NDArray[np.float64], NDArray[np.int64]
RUNS, PRIOR = 200, 3.0
FEATURES, DEMONSTRATIONS, NODES = 3, 8, 7  # of the small process
_RANKS, _BINS = 99, 10  # draws that a true weight is ranked among; bins of the ranks
# Many short chains cost little more than a few, and their draws are worth more than the 99 that are taken.
_CHAINS, _DRAWS, _WARM_UP = 24, 2_000, 1_500


@dataclass(frozen=True)
class Calibration:
    """ranks: of the true weights among the draws, (R, K), 0 to 99. covered: share of them in their 90 % intervals."""

    ranks: I64
    covered: float

    @property
    def counts(self) -> I64:
        """Every weight's ranks in bins of equal probability, (K, 10)."""
        return np.array([np.bincount(one * _BINS // (_RANKS + 1), minlength=_BINS) for one in self.ranks.T])

    @property
    def p_value(self) -> float:
        """Probability of ranks so far from uniform, or farther, by chi-squared.

        Ranks of a weight are independent, but not those of a run's weights, so each weight is tested by itself, and the
        least of their probabilities counts K times (Bonferroni).
        """
        return min(1.0, len(self.counts) * float(chisquare(self.counts, axis=1).pvalue.min()))


def calibrate(rng: np.random.Generator, runs: int = RUNS) -> Calibration:
    """Return the ranks of drawn weights in the posteriors of what they choose in small processes."""
    ranks, covered = np.empty((runs, FEATURES), np.int64), 0
    for run in range(runs):
        sums = [small_choices(rng) for _ in range(DEMONSTRATIONS)]
        truth = prior_tastes(1, FEATURES, rng, PRIOR)[0]
        chosen = [choose(one, truth, rng) for one in sums]
        draws = draw_posterior(Choices.of(chosen), rng, PRIOR, _DRAWS, _WARM_UP, _CHAINS).draws
        ranks[run] = (draws.thin(_RANKS) < truth).sum(axis=0)
        low, high = np.quantile(draws.pooled, [0.05, 0.95], axis=0)
        covered += int(((low <= truth) & (truth <= high)).sum())
    return Calibration(ranks, covered / ranks.size)


def choose(sums: F64, weights: F64, rng: np.random.Generator) -> F64:
    """Return the same sums (m, K) with one first that is drawn with probability proportional to exp(-cost)."""
    costs = sums @ weights
    chances = np.exp(costs.min() - costs)
    one = int(rng.choice(len(sums), p=chances / chances.sum()))
    return np.concatenate([sums[[one]], np.delete(sums, one, axis=0)])


def small_choices(rng: np.random.Generator) -> F64:
    """Return the feature sums of all paths through a small random process without circles, (m, K)."""
    pairs = [(i, j) for i in range(NODES) for j in range(i + 1, NODES) if j == i + 1 or rng.random() < 0.6]
    problem = PathProblem(np.array(pairs), rng.random((len(pairs), FEATURES)), NODES, NODES - 1)
    return np.array([problem.sums(path) for path in all_paths(problem, 0)])


def all_paths(problem: PathProblem, start: int) -> Sequence[I64]:
    """Return every path (n,) from a start to the goal of a problem without circles."""
    found, unfinished = list[I64](), [[start]]
    while unfinished:
        path = unfinished.pop()
        if path[-1] == problem.goal:
            found.append(np.array(path, np.int64))
            continue
        unfinished += [[*path, int(to)] for to in problem.edges[problem.edges[:, 0] == path[-1], 1]]
    return found
