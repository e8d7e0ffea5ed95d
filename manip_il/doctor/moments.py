"""Statistics of a column that passes by in pieces: exact, in float64, without keeping it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass
class Moments:
    """Of a column whose frames have `size` numbers. quantiles: (Q, size), whose ranks are counted."""

    size: int
    quantiles: F64 | None = None
    rows: int = 0
    bad_rows: int = 0  # with a number that is not finite
    first_bad: tuple[int, float] | None = None  # row in the dataset, value
    low: F64 = field(init=False)
    high: F64 = field(init=False)
    mean: F64 = field(init=False)
    squares: F64 = field(init=False)  # sum of squared distances from the mean
    below: NDArray[np.int64] | None = field(init=False, default=None)  # (Q, size): numbers below each quantile
    up_to: NDArray[np.int64] | None = field(init=False, default=None)  # and those not above

    def __post_init__(self) -> None:
        self.low, self.high = np.full(self.size, np.inf), np.full(self.size, -np.inf)
        self.mean, self.squares = np.zeros(self.size), np.zeros(self.size)
        if self.quantiles is not None:
            self.below = np.zeros(self.quantiles.shape, dtype=np.int64)
            self.up_to = np.zeros(self.quantiles.shape, dtype=np.int64)

    def add(self, values: NDArray[Any], first_row: int) -> None:
        """Take the next rows, (T, size) numbers; `first_row` is where they begin."""
        if not values.size:
            return
        values = values.astype(np.float64)
        finite = np.isfinite(values)
        if not finite.all():
            bad = np.flatnonzero(~finite.all(axis=1))
            if self.first_bad is None:
                row = int(bad[0])
                self.first_bad = first_row + row, float(values[row][~finite[row]][0])
            self.bad_rows += len(bad)
            return  # of a column with such numbers no statistics are compared
        with np.errstate(all="ignore"):
            self._merge(values)
        if self.quantiles is not None and self.below is not None and self.up_to is not None:
            for number, quantile in enumerate(self.quantiles):
                self.below[number] += (values < quantile).sum(axis=0)
                self.up_to[number] += (values <= quantile).sum(axis=0)

    @property
    def std(self) -> F64:
        """(size,)."""
        return np.sqrt(self.squares / max(self.rows, 1))

    def over_last_axis(self, shape: tuple[int, ...]) -> Moments:
        """Of all numbers that share a place on the frame's last axis: LeRobot's statistics of a matrix."""
        merged = Moments(shape[-1])
        with np.errstate(all="ignore"):
            means, squares = self.mean.reshape(-1, shape[-1]), self.squares.reshape(-1, shape[-1])
            merged.low = self.low.reshape(-1, shape[-1]).min(axis=0)
            merged.high = self.high.reshape(-1, shape[-1]).max(axis=0)
            merged.mean = means.mean(axis=0)
            merged.squares = (squares + self.rows * (means - merged.mean) ** 2).sum(axis=0)
        merged.rows = self.rows * len(means)
        return merged

    def _merge(self, values: F64) -> None:
        """Chan, Golub and LeVeque (1983), their pairwise update."""
        count, mean = len(values), values.mean(axis=0)
        total, shift = self.rows + count, mean - self.mean
        self.squares += ((values - mean) ** 2).sum(axis=0) + shift**2 * (self.rows * count / total)
        self.mean += shift * (count / total)
        self.low, self.high = np.minimum(self.low, values.min(axis=0)), np.maximum(self.high, values.max(axis=0))
        self.rows = total
