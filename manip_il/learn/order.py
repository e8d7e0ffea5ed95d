"""In which order samples are learnt from."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray


class ShuffledRows:
    """Row numbers in batches, every row once an epoch, in an order of its own each epoch.

    A batch is a function of the seed and the step alone, so there is no state to save.
    """

    def __init__(self, rows: int, batch_size: int, seed: int) -> None:
        self.rows, self.batch_size, self.seed = rows, batch_size, seed
        self._epoch, self._order = -1, torch.empty(0, dtype=torch.int64)

    def batch(self, step: int) -> torch.Tensor:
        """Return row numbers of the batch of `step`, (batch_size,)."""
        start, end = step * self.batch_size, (step + 1) * self.batch_size
        pieces = []
        while start < end:
            epoch, place = divmod(start, self.rows)
            piece = self._permutation(epoch)[place : place + end - start]
            pieces.append(piece)
            start += len(piece)
        return pieces[0] if len(pieces) == 1 else torch.cat(pieces)

    def _permutation(self, epoch: int) -> torch.Tensor:
        if epoch != self._epoch:
            seed = int(np.random.SeedSequence([self.seed, epoch]).generate_state(1, np.uint64)[0] >> 1)
            generator = torch.Generator().manual_seed(seed)
            self._epoch, self._order = epoch, torch.randperm(self.rows, generator=generator)
        return self._order


class WeightedRows:
    """Row numbers in batches, each drawn with a probability in proportion to its weight, (N,), with replacement."""

    def __init__(self, weights: NDArray[np.float64], batch_size: int, seed: int) -> None:
        self._edges = np.cumsum(weights) / weights.sum()
        self.batch_size, self.seed = batch_size, seed

    def batch(self, step: int) -> torch.Tensor:
        """Return row numbers of the batch of `step`, (batch_size,)."""
        draws = np.random.default_rng([self.seed, step]).uniform(size=self.batch_size)
        rows = np.searchsorted(self._edges, draws, side="right")
        return torch.from_numpy(np.minimum(rows, len(self._edges) - 1))


def order_of(rows: int, weights: NDArray[np.float64] | None, batch_size: int, seed: int) -> ShuffledRows | WeightedRows:
    """By weight where there are weights, else every row once an epoch."""
    return ShuffledRows(rows, batch_size, seed) if weights is None else WeightedRows(weights, batch_size, seed)


def batches_of(samples: NDArray[np.int64], size: int) -> list[NDArray[np.int64]]:
    """Return samples in their order, in pieces of at most `size`."""
    return [samples[start : start + size] for start in range(0, len(samples), size)]
