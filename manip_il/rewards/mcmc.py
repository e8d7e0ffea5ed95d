"""Markov chains that draw from a density: random-walk Metropolis whose steps are fitted in a warm-up, then fixed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError

F64 = NDArray[np.float64]
Density = Callable[[F64], F64]  # logarithms (C,) at points (C, K)
CHAINS = 4
_WANTED = 0.25  # share of steps taken at which a random walk in several dimensions gets on best (Roberts et al. 1997)
_WINDOW = 100  # steps of the warm-up after which the steps are fitted anew
_JITTER = 1e-6


@dataclass(frozen=True)
class Draws:
    """points: (C, N, K) of C chains. accepted: share of steps taken."""

    points: F64
    accepted: float

    @property
    def pooled(self) -> F64:
        """All chains' draws, (C N, K)."""
        return self.points.reshape(-1, self.points.shape[2])

    def thin(self, count: int) -> F64:
        """Return draws that are evenly apart along the chains, (count, K)."""
        return self.pooled[np.linspace(0, len(self.pooled) - 1, count).round().astype(np.int64)]


def sample(density: Density, start: F64, count: int, warm_up: int, rng: np.random.Generator) -> Draws:
    """Return `count` draws of every chain that begins at `start` (C, K), after `warm_up` steps that are thrown away.

    A step's covariance is that of the warm-up's second half, scaled so that a quarter of the steps is taken (Haario et
    al. 2001, but fixed before the first draw that counts). Raises `ManipError` where the density is 0 at a start.
    """
    chains, size = start.shape
    now, height = start.copy(), density(start)
    if not np.isfinite(height).all():
        raise ManipError("a chain starts where the density is 0")
    root, scale = np.eye(size), 0.3
    seen = np.empty((chains, warm_up, size))
    points, taken = np.empty((chains, count, size)), 0
    for step in range(-warm_up, count):
        proposed = now + scale * rng.standard_normal((chains, size)) @ root.T
        there = density(proposed)
        accept = np.log(rng.random(chains)) < there - height
        now, height = np.where(accept[:, None], proposed, now), np.where(accept, there, height)
        if step >= 0:
            points[:, step] = now
            taken += int(accept.sum())
            continue
        done = step + warm_up + 1
        seen[:, done - 1] = now
        scale *= float(np.exp((accept.mean() - _WANTED) / np.sqrt(done / 10 + 1)))
        if done % _WINDOW == 0 and done < warm_up:
            root, scale = _fit_steps(seen[:, done // 2 : done], root, scale)
    return Draws(points, taken / (chains * count))


def _fit_steps(seen: F64, root: F64, scale: float) -> tuple[F64, float]:
    """A Cholesky root of the points' covariance, and the scale that keeps a step's size."""
    size = seen.shape[2]
    found = np.linalg.cholesky(np.cov(seen.reshape(-1, size).T).reshape(size, size) + _JITTER * np.eye(size)).astype(
        np.float64
    )
    same = scale * float(np.linalg.norm(root) / np.linalg.norm(found))
    return found, min(same, 2.38 / size**0.5)


def effective_size(points: F64) -> F64:
    """Return how many independent draws the draws (C, N, K) are worth, (K,): autocorrelation until it is noise.

    Sums of neighbouring autocorrelations count as long as they are above 0 (Geyer 1992); chains that disagree count
    less (Gelman et al. 2013, eq. 11.7).
    """
    chains, count, size = points.shape
    within = points.var(axis=1, ddof=1).mean(axis=0)
    between = points.mean(axis=1).var(axis=0, ddof=1) if chains > 1 else np.zeros(size)
    total = within * (count - 1) / count + between
    centred = points - points.mean(axis=1, keepdims=True)
    spectrum = np.abs(np.fft.rfft(centred, 2 * count, axis=1)) ** 2
    covariance = np.fft.irfft(spectrum, axis=1)[:, :count].mean(axis=0) / count
    found = np.empty(size)
    for k in range(size):
        correlation = 1 - (within[k] - covariance[:, k]) / max(total[k], np.finfo(float).tiny)
        pairs = correlation[: count - count % 2].reshape(-1, 2).sum(axis=1)
        ends = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)
        found[k] = chains * count / max(2 * pairs[:ends].sum() - 1, 1 / np.log10(chains * count))
    return found


def agreement(points: F64) -> F64:
    """Return R-hat of draws (C, N, K) in halves of chains, (K,); 1 where they agree (Gelman et al. 2013, eq. 11.4)."""
    half = points.shape[1] // 2
    parts = np.concatenate([points[:, :half], points[:, half : 2 * half]])
    within = parts.var(axis=1, ddof=1).mean(axis=0)
    between = parts.mean(axis=1).var(axis=0, ddof=1)
    return np.sqrt((half - 1) / half + between / np.maximum(within, np.finfo(float).tiny))
